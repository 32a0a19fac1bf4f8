import type { Object3D, PerspectiveCamera, Ray, Vector3 } from "three";

/** Takes clicks, moves and keys in the view, in place of the selection of buildings. */
export interface Tool {
  /** A click on a place of the scene, null beside everything. */
  clicked(place: Vector3 | null): void;
  /** The pointer moved over a place of the scene. */
  hovered(place: Vector3 | null): void;
  /** True if the key is the tool's. */
  typed(event: KeyboardEvent): boolean;
}

/** Something drawn beside the models. */
export interface Layer {
  readonly object: Object3D;
  /** Called before each frame; the height of the view is in device pixels. */
  update?(camera: PerspectiveCamera, heightPx: number): void;
  /** The nearest thing along a ray up to a distance, within `reach` metres per metre of distance beside it. */
  pick?(ray: Ray, reach: number, farthest: number): Vector3 | null;
  dispose(): void;
}
