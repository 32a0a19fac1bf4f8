/** One building with its points in 3D, in the view of all models. */

import { BufferAttribute, BufferGeometry, Color, Points as PointCloud, PointsMaterial } from "three";
import type { Batch } from "../models/batching";
import type { Layer } from "../scene/layer";
import { ModelScene } from "../scene/scene";
import { pointColour, type Colouring } from "./dossier_drawings";
import type { Points } from "./dossier_geometry";

/** The points of a building, each in its colour. */
class Cloud implements Layer {
  readonly object: PointCloud<BufferGeometry, PointsMaterial>;

  constructor(private readonly points: Points) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(Float32Array.from(points.xyz), 3));
    const size = points.residuals.length > 3000 ? 1.7 : 2.5;
    this.object = new PointCloud(geometry, new PointsMaterial({ size, sizeAttenuation: false, vertexColors: true }));
  }

  colour(colouring: Colouring): void {
    const colours = new Float32Array(this.points.xyz.length);
    const colour = new Color();
    this.points.residuals.forEach((_, i) => colour.set(pointColour(this.points, i, colouring)).toArray(colours, 3 * i));
    this.object.geometry.setAttribute("color", new BufferAttribute(colours, 3));
  }

  dispose(): void {
    this.object.geometry.dispose();
    this.object.material.dispose();
  }
}

export class DossierScene {
  private readonly scene: ModelScene;
  private readonly cloud: Cloud | null;

  /** @throws Error if the browser has no WebGL. */
  constructor(canvas: HTMLCanvasElement, batches: readonly Batch[], points: Points | null, colouring: Colouring) {
    this.scene = new ModelScene(canvas, null);
    this.scene.add(batches);
    this.scene.models.colourBy("plain");
    this.cloud = points === null ? null : new Cloud(points);
    if (this.cloud === null) return;
    this.cloud.colour(colouring);
    this.scene.addLayer(this.cloud);
  }

  colour(colouring: Colouring): void {
    this.cloud?.colour(colouring);
    this.scene.request();
  }

  dispose(): void {
    this.scene.dispose();
  }
}
