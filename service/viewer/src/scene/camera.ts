/** Where the view is seen from: it flies to what it shows, and may follow another view. */

import { MathUtils, PerspectiveCamera, Vector3, type Box3 } from "three";
import { framing } from "./framing";
import { EYE_M, Navigation, type Surfaces } from "./navigation";

const FOV_DEG = 32;
/** Half the height of the view per distance. */
export const TAN_HALF_FOV = Math.tan((FOV_DEG * Math.PI) / 360);
const START = new Vector3(-0.42, -1, 0.72); // seen from the south-south-west, half from above
const CLOSEST_FIT_M = 12;
const RISE_RAD = (5 * Math.PI) / 180; // a step up to where a hill no longer is in the way
const NEAREST_PLANE_M = 0.1;
const IN_FRAME = 0.7; // of a distance, along the view axis: less than the cosine at the corners of a wide view
const FLIGHT_MS = 450;

/** Gets the position of the camera and what it looks at. */
export type OnMove = (position: Vector3, target: Vector3) => void;

export class Camera {
  readonly view = new PerspectiveCamera(FOV_DEG, 1, 1, 10_000);
  readonly navigation: Navigation;
  private readonly still = matchMedia("(prefers-reduced-motion: reduce)");
  private flight: { from: number; start: [Vector3, Vector3]; end: [Vector3, Vector3] } | null = null;
  private onMove: OnMove | null = null;
  /** The view that `onMove` knows. */
  private known = "";

  /** @param request Asks for a frame. */
  constructor(
    canvas: HTMLElement,
    private readonly surfaces: Surfaces,
    private readonly request: () => void,
  ) {
    this.view.up.set(0, 0, 1);
    this.navigation = new Navigation(this.view, canvas, surfaces, request, () => (this.flight = null), !this.still.matches);
  }

  get isFlying(): boolean {
    return this.flight !== null;
  }

  /** Distance to what is looked at. */
  get distance(): number {
    return this.view.position.distanceTo(this.navigation.target);
  }

  /** Call a function whenever the camera has moved, but not after `look`; `atOnce` also now. */
  watch(onMove: OnMove, atOnce = false): void {
    this.onMove = onMove;
    this.known = this.words();
    if (atOnce) onMove(this.view.position, this.navigation.target);
  }

  /** Look as another camera does; above the own ground in any case. */
  look(position: Vector3, target: Vector3): void {
    this.flight = null;
    this.navigation.touched = true;
    this.navigation.place(position, target);
    this.known = this.words();
  }

  /** The ground has changed: stay above it. */
  stayAbove(): void {
    this.navigation.place(this.view.position.clone(), this.navigation.target.clone());
  }

  /** See all boxes from where the camera is, at first from the start. */
  fit(boxes: readonly Box3[], animated: boolean): void {
    this.flyTo(boxes, this.navigation.touched ? this.heading() : START.clone(), 1.0, animated);
  }

  /** See all boxes from straight above, north up. */
  top(boxes: readonly Box3[]): void {
    this.navigation.touched = true;
    this.flyTo(boxes, new Vector3(0, -0.001, 1), 1.0);
  }

  /** See one box from the same side, with much around it. */
  approach(box: Box3): void {
    this.flyTo([box], this.heading(), 3.2);
  }

  setAspect(aspect: number): void {
    this.view.aspect = aspect;
    this.view.updateProjectionMatrix();
  }

  /** Move on by a frame. */
  update(now: number): void {
    if (this.flight !== null) this.fly(now);
    else this.navigation.controls.update(); // a step of damped movements
    if (this.onMove === null || this.words() === this.known) return;
    this.known = this.words();
    this.onMove(this.view.position, this.navigation.target);
  }

  /** Height above the ground; infinity without one. */
  aboveGround(): number {
    const { x, y, z } = this.view.position;
    return z - this.surfaces.groundAt(x, y);
  }

  /** Draw from just before the nearest model or the ground to behind the farthest. */
  setPlanes(nearestModel: number): void {
    const { bounds } = this.surfaces;
    const reach = bounds.isEmpty() ? 100 : bounds.getSize(new Vector3()).length();
    const nearest = Math.min(nearestModel, this.aboveGround());
    // on a slope the ground beside the camera is nearer than the ground below it
    this.view.near = Math.max(NEAREST_PLANE_M, 0.5 * IN_FRAME * Math.min(nearest, 2 * reach));
    this.view.far = bounds.isEmpty() ? 1000 : this.view.position.distanceTo(bounds.getCenter(new Vector3())) + 1.5 * reach;
    this.view.updateProjectionMatrix();
  }

  /** Place and target, to see whether they have moved by a millimetre. */
  private words(): string {
    return [...this.view.position.toArray(), ...this.navigation.target.toArray()].map((value) => value.toFixed(3)).join(" ");
  }

  /** From the target to the camera. */
  private heading(): Vector3 {
    return this.view.position.clone().sub(this.navigation.target);
  }

  /** See boxes from a direction, at `room` times the distance that they need; from farther up where a hill is there. */
  private flyTo(boxes: readonly Box3[], direction: Vector3, room: number, animated = true): void {
    if (boxes.length === 0) return;
    const [east, north] = [direction.x, direction.y];
    const plan = Math.max(Math.hypot(east, north), 1e-3);
    let steep = Math.atan2(direction.z, plan);
    let [target, position] = [new Vector3(), new Vector3()];
    for (;;) {
      direction.set((Math.cos(steep) * east) / plan, (Math.cos(steep) * north) / plan, Math.sin(steep)).normalize();
      const view = framing(boxes, direction, TAN_HALF_FOV, this.view.aspect);
      target = view.target;
      position = target.clone().addScaledVector(direction, Math.max(1.06 * room * view.distance, CLOSEST_FIT_M));
      const hidden = position.z < this.surfaces.groundAt(position.x, position.y) + EYE_M;
      if (!hidden || steep + RISE_RAD > Math.PI / 2) break;
      steep += RISE_RAD;
    }
    if (!animated || this.still.matches) {
      this.navigation.place(position, target);
    } else {
      const start: [Vector3, Vector3] = [this.navigation.target.clone(), this.view.position.clone()];
      this.flight = { from: performance.now(), start, end: [target, position] };
    }
    this.request();
  }

  private fly(now: number): void {
    if (this.flight === null) return;
    const { from, start, end } = this.flight;
    const eased = MathUtils.smoothstep(now, from, from + FLIGHT_MS);
    if (eased === 1) this.flight = null;
    this.navigation.place(new Vector3().lerpVectors(start[1], end[1], eased), new Vector3().lerpVectors(start[0], end[0], eased));
  }
}
