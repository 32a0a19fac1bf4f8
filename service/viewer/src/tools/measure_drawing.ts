import { BufferGeometry, Float32BufferAttribute, Group, Points, PointsMaterial, Vector3 } from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import type { Layer } from "../scene/layer";

/** Seen on every roof and on both backgrounds: a dark line with a bright core. */
const CASING = "#101418";
const CORE = "#ffe14d";

/** The line between two places with its legs in plan and upright, drawn over everything. */
export class MeasureDrawing implements Layer {
  readonly object = new Group();
  private readonly casing = new LineMaterial({ color: CASING, linewidth: 6, depthTest: false, transparent: true });
  private readonly core = new LineMaterial({ color: CORE, linewidth: 3, depthTest: false, transparent: true });
  private readonly legs = new LineMaterial({ color: CORE, linewidth: 1.5, depthTest: false, transparent: true });
  private readonly rim = new PointsMaterial({ color: CASING, size: 11, sizeAttenuation: false, depthTest: false, transparent: true });
  private readonly dot = new PointsMaterial({ color: CORE, size: 7, sizeAttenuation: false, depthTest: false, transparent: true });

  /** Draw none, one or two places. */
  show(places: readonly Vector3[]): void {
    this.clear();
    const [from, to] = places;
    if (from !== undefined && to !== undefined) {
      // the right angle is below or above the higher place
      const corner = from.z < to.z ? new Vector3(to.x, to.y, from.z) : new Vector3(from.x, from.y, to.z);
      this.line([from, corner, corner, to], this.legs, 1);
      this.line([from, to], this.casing, 2);
      this.line([from, to], this.core, 3);
    }
    if (places.length === 0) return;
    for (const [material, order] of [[this.rim, 4], [this.dot, 5]] as const) {
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new Float32BufferAttribute(places.flatMap((place) => place.toArray()), 3));
      const points = new Points(geometry, material);
      points.renderOrder = 10 + order;
      points.frustumCulled = false;
      this.object.add(points);
    }
  }

  dispose(): void {
    this.clear();
    for (const material of [this.casing, this.core, this.legs, this.rim, this.dot]) material.dispose();
  }

  private line(ends: readonly Vector3[], material: LineMaterial, order: number): void {
    const geometry = new LineSegmentsGeometry().setPositions(ends.flatMap((end) => end.toArray()));
    const line = new LineSegments2(geometry, material);
    line.renderOrder = 10 + order;
    line.frustumCulled = false;
    this.object.add(line);
  }

  private clear(): void {
    for (const object of [...this.object.children]) {
      this.object.remove(object);
      (object as Points | LineSegments2).geometry.dispose();
    }
  }
}
