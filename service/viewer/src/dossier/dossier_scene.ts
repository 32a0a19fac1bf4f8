/** A small 3D view of one building with its points; it turns with the pointer and the arrow keys. */

import {
  Box3,
  BufferAttribute,
  BufferGeometry,
  Color,
  DirectionalLight,
  DoubleSide,
  HemisphereLight,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshLambertMaterial,
  PerspectiveCamera,
  Points as PointCloud,
  PointsMaterial,
  Scene,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { buildingMesh, type BuildingMesh, type SceneFrame } from "../models/building_mesh";
import type { Building } from "../models/cityjson";
import { onKeys } from "../page/elements";
import { pointColour, type Colouring } from "./dossier_drawings";
import type { Points } from "./dossier_geometry";

const FOV_DEG = 30;
const START = new Vector3(-0.35, -0.78, 0.52); // from the south-south-west, a third from above
const [HIGHEST_RAD, LOWEST_RAD] = [0.02, Math.PI / 2 + 0.2]; // from straight above
const SURFACES = { roof: "#cfd6dd", wall: "#e9e5dd", ground: "#b9b3a8" } as const;

export class DossierScene {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(FOV_DEG, 1, 0.1, 5000);
  private readonly controls: OrbitControls;
  private readonly cloud: PointCloud | null = null;
  private readonly watch: ResizeObserver;
  private frame = 0;

  /** @throws Error if the browser has no WebGL. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    building: Building,
    frame: SceneFrame,
    private readonly points: Points | null,
    colouring: Colouring,
  ) {
    // kept after drawing, so that it can be printed
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    const sun = new DirectionalLight("#fff6e8", 1.9);
    sun.position.set(-0.4, -0.8, 1.2);
    this.scene.add(new HemisphereLight("#f4f8ff", "#a89f92", 2), sun);
    const mesh = buildingMesh(building, frame);
    if (mesh.positions.length > 0) this.addModel(mesh);
    const bounds = new Box3().setFromArray(mesh.positions);
    if (points !== null && points.xyz.length > 0) {
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(Float32Array.from(points.xyz), 3));
      this.cloud = new PointCloud(geometry, new PointsMaterial({ size: points.residuals.length > 3000 ? 1.7 : 2.5, sizeAttenuation: false, vertexColors: true }));
      this.scene.add(this.cloud);
      bounds.union(new Box3().setFromArray(points.xyz));
    }
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { enablePan: false, minDistance: 1, maxDistance: 2000, minPolarAngle: HIGHEST_RAD, maxPolarAngle: LOWEST_RAD });
    bounds.getCenter(this.controls.target);
    const distance = Math.max(2, bounds.getSize(new Vector3()).length() / 2.3 / Math.sin((FOV_DEG * Math.PI) / 360));
    this.camera.position.copy(this.controls.target).addScaledVector(START, distance);
    this.controls.addEventListener("change", () => this.request());
    onKeys(canvas, {
      ArrowLeft: () => this.controls.rotateLeft(0.15),
      ArrowRight: () => this.controls.rotateLeft(-0.15),
      ArrowUp: () => this.controls.rotateUp(0.12),
      ArrowDown: () => this.controls.rotateUp(-0.12),
      "+": () => this.controls.dollyIn(0.85),
      "-": () => this.controls.dollyOut(0.85),
    });
    this.watch = new ResizeObserver(() => this.resize());
    this.watch.observe(canvas);
    this.colour(colouring);
    this.resize();
  }

  colour(colouring: Colouring): void {
    const { points } = this;
    if (this.cloud === null || points === null) return;
    const colours = points.residuals.length;
    this.cloud.geometry.setAttribute("color", coloursOf(Array.from({ length: colours }, (_, i) => pointColour(points, i, colouring))));
    this.request();
  }

  dispose(): void {
    this.controls.dispose();
    this.watch.disconnect();
    cancelAnimationFrame(this.frame);
    this.scene.traverse((object) => {
      if (!(object instanceof Mesh || object instanceof LineSegments || object instanceof PointCloud)) return;
      object.geometry.dispose();
      for (const material of [object.material].flat()) material.dispose();
    });
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  private addModel({ positions, normals, kinds, edges }: BuildingMesh): void {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(Float32Array.from(positions), 3));
    geometry.setAttribute("normal", new BufferAttribute(Int8Array.from(normals), 3, true));
    geometry.setAttribute("color", coloursOf(kinds.map((kind) => SURFACES[kind])));
    const surface = new MeshLambertMaterial({ vertexColors: true, side: DoubleSide, polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2 });
    const lines = new BufferGeometry();
    lines.setAttribute("position", new BufferAttribute(Float32Array.from(edges), 3));
    this.scene.add(new Mesh(geometry, surface), new LineSegments(lines, new LineBasicMaterial({ color: "#39424b" })));
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.controls.update();
    this.draw();
  }

  private request(): void {
    cancelAnimationFrame(this.frame);
    this.frame = requestAnimationFrame(() => this.draw());
  }

  private draw(): void {
    const distance = this.controls.getDistance();
    Object.assign(this.camera, { near: distance / 100, far: 4 * distance + 500 });
    this.camera.updateProjectionMatrix();
    this.renderer.render(this.scene, this.camera);
    this.canvas.dataset["drawn"] = "true";
  }
}

/** The colours of corners or points for the graphics card. */
function coloursOf(colours: readonly string[]): BufferAttribute {
  const values = new Float32Array(3 * colours.length);
  const colour = new Color();
  colours.forEach((one, i) => colour.set(one).toArray(values, 3 * i));
  return new BufferAttribute(values, 3);
}
