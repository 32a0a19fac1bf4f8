/**
 * Moves the camera: orbit, pan and zoom about the surface under the pointer, which the camera never passes.
 *
 * OrbitControls turns around a target on the view axis and pans. Here it turns around any point instead, zooming is our
 * own, and each step is held back by the ground and by the models.
 */

import { MOUSE, Ray, Vector2, Vector3, type Box3, type PerspectiveCamera, type Quaternion } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { crossing } from "./ground";

/** A surface that a ray meets. */
export interface Met {
  distance: number;
  /** The ground, not a model. */
  isGround: boolean;
}

/** What the camera may meet. Rays have unit directions. */
export interface Surfaces {
  /** The first model or the ground; null if the ray meets neither. */
  meet(ray: Ray): Met | null;
  /** Distance to the first model whose outer side the ray meets, infinity for none. */
  wall(ray: Ray): number;
  /** Height of the ground, minus infinity where none is known. */
  groundAt(x: number, y: number): number;
  /** All models. */
  readonly bounds: Box3;
}

/** Height of the eye above the ground, that of a person. */
export const EYE_M = 1.7;
const NEAREST_M = 12; // to a model: the view is 7 m high, and more than one face of a house is seen
const NEAREST_GROUND_M = 30; // the view is 17 m high: on bare ground nothing is left to see from nearer
const WALL_M = 0.3; // from the near plane to a wall beside the camera
const FARTHEST_RADII = 6; // of the scene, from its middle: beyond this it is a dot
const NOTCH_PX = 100; // that browsers report for a notch of the wheel
const NOTCH = 1.1; // nearer by a notch
const LINE_PX = 16;
const PAGE_PX = 400;
const CENTRE = new Vector2(0, 0);
const MAX_POLAR_RAD = 0.495 * Math.PI;
const POINTER = ["pointerdown", "pointermove", "pointerup", "pointercancel"] as const;

export class Navigation {
  readonly controls: OrbitControls;
  /** Whether the user moved the camera. */
  touched = false;
  private readonly pivot = new Vector3();
  private readonly before: { position: Vector3; target: Vector3; quaternion: Quaternion };
  private readonly fingers = new Map<number, Vector2>();

  /**
   * @param onMove Called after each step.
   * @param onStart Called when the user begins to move the camera.
   */
  constructor(
    private readonly camera: PerspectiveCamera,
    private readonly canvas: HTMLElement,
    private readonly surfaces: Surfaces,
    private readonly onMove: () => void,
    private readonly onStart: () => void,
    damping: boolean,
  ) {
    // the first of all listeners: they must know the surface before OrbitControls acts
    canvas.addEventListener("wheel", this.wheeled, { passive: false });
    for (const kind of POINTER) canvas.addEventListener(kind, this.fingered);
    this.controls = new OrbitControls(camera, canvas);
    this.controls.maxPolarAngle = MAX_POLAR_RAD;
    this.controls.enableZoom = false;
    this.controls.mouseButtons = { LEFT: MOUSE.ROTATE, MIDDLE: MOUSE.PAN, RIGHT: MOUSE.PAN };
    this.controls.enableDamping = damping;
    this.controls.dampingFactor = 0.12;
    this.controls.screenSpacePanning = false;
    this.before = { position: camera.position.clone(), target: new Vector3(), quaternion: camera.quaternion.clone() };
    this.controls.addEventListener("change", () => this.follow());
    this.controls.addEventListener("start", () => this.begin());
  }

  get target(): Vector3 {
    return this.controls.target;
  }

  /** Place the camera; `target` is what it looks at. Above the ground in any case. */
  place(position: Vector3, target: Vector3): void {
    this.camera.position.copy(position);
    this.controls.target.copy(target);
    this.pivot.copy(target);
    this.lift();
    this.settle();
  }

  /**
   * Nearer to the surface at a place of the view (above 1) or farther from it.
   *
   * @param at -1 to 1 in both directions, as seen.
   */
  zoom(factor: number, at: Vector2 = CENTRE): void {
    this.begin();
    let ray = this.ray(at);
    let met = this.surfaces.meet(ray);
    if (met === null) {
      ray = this.ray(CENTRE);
      met = this.surfaces.meet(ray);
    }
    const { position } = this.camera;
    const middle = this.surfaces.bounds.getCenter(new Vector3());
    if (met === null) {
      // nothing is seen there: back off from everything, but do not fly into the sky
      if (factor >= 1) return;
      met = { distance: position.distanceTo(middle), isGround: false };
      ray = new Ray(position.clone(), middle.clone().sub(position).normalize());
    }
    const { distance, isGround } = met;
    const hit = ray.at(distance, new Vector3());
    const next = Math.max(distance / factor, Math.min(distance, isGround ? NEAREST_GROUND_M : NEAREST_M));
    const moved = hit.clone().addScaledVector(ray.direction, -next);
    const radius = this.surfaces.bounds.getSize(new Vector3()).length() / 2;
    if (factor < 1 && moved.distanceTo(middle) > Math.max(FARTHEST_RADII * radius, position.distanceTo(middle))) return;
    position.copy(factor > 1 ? this.lastAbove(position, moved) : moved);
    this.turnAbout(hit);
    this.lift();
    this.settle();
  }

  /** Turn around the surface in the middle of the view, in degrees: to the left, and up. */
  turn(leftDeg: number, upDeg: number): void {
    this.begin();
    this.grasp(CENTRE);
    this.controls.rotateLeft((leftDeg * Math.PI) / 180);
    this.controls.rotateUp((upDeg * Math.PI) / 180);
  }

  dispose(): void {
    this.controls.dispose();
    this.canvas.removeEventListener("wheel", this.wheeled);
    for (const kind of POINTER) this.canvas.removeEventListener(kind, this.fingered);
  }

  private begin(): void {
    this.touched = true;
    this.onStart();
  }

  /** Look at the target from the new place, and let OrbitControls start from there. */
  private settle(): void {
    this.camera.lookAt(this.controls.target);
    this.remember();
    this.controls.update();
    this.onMove();
  }

  private remember(): void {
    this.before.position.copy(this.camera.position);
    this.before.target.copy(this.controls.target);
    this.before.quaternion.copy(this.camera.quaternion);
  }

  /**
   * OrbitControls turned by R around its target t; move on so that it was a turn around the pivot p.
   *
   * A turn around t takes c to t + R (c - t), one around p to p + R (c - p): they differ by p - t + R (t - p).
   */
  private follow(): void {
    const { position, target, quaternion } = this.before;
    const turned = this.camera.quaternion.clone().multiply(quaternion.clone().invert());
    this.shift(target.clone().sub(this.pivot).applyQuaternion(turned).add(this.pivot).sub(target));
    this.holdBack(position.clone());
    this.lift();
    this.remember();
    this.onMove();
  }

  private shift(by: Vector3): void {
    this.camera.position.add(by);
    this.controls.target.add(by);
  }

  /** End a step where a wall begins. */
  private holdBack(from: Vector3): void {
    const step = this.camera.position.clone().sub(from);
    const length = step.length();
    if (length === 0) return;
    const direction = step.divideScalar(length);
    const free = Math.max(this.surfaces.wall(new Ray(from, direction)) - WALL_M, 0);
    if (free < length) this.shift(direction.multiplyScalar(free - length));
  }

  /** Not below the eye's height above the ground. */
  private lift(): void {
    const missing = -this.clearance(this.camera.position);
    if (missing > 0) this.shift(new Vector3(0, 0, missing));
  }

  /** Height above the lowest place of the eye. */
  private clearance({ x, y, z }: Vector3): number {
    return z - this.surfaces.groundAt(x, y) - EYE_M;
  }

  /** The last place on the way that is not too low: a zoom ends there and does not creep along the ground. */
  private lastAbove(from: Vector3, to: Vector3): Vector3 {
    if (this.clearance(to) >= 0) return to;
    const place = (share: number): Vector3 => new Vector3().lerpVectors(from, to, share);
    return place(crossing((share) => this.clearance(place(share)), 0, 1));
  }

  /** Turn around a point from now on; the view stays. */
  private turnAbout(point: Vector3): void {
    this.pivot.copy(point);
    const forward = this.camera.getWorldDirection(new Vector3());
    const depth = Math.max(point.clone().sub(this.camera.position).dot(forward), NEAREST_M);
    this.controls.target.copy(this.camera.position).addScaledVector(forward, depth);
    this.remember();
  }

  /** The ray through a place of the view, -1 to 1 in both directions. */
  ray(at: Vector2): Ray {
    this.camera.updateMatrixWorld();
    const { position } = this.camera;
    const direction = new Vector3(at.x, at.y, 0.5).unproject(this.camera).sub(position).normalize();
    return new Ray(position.clone(), direction);
  }

  /** A place of the page, within the view: -1 to 1. */
  inView(x: number, y: number): Vector2 {
    const frame = this.canvas.getBoundingClientRect();
    return new Vector2((2 * (x - frame.left)) / frame.width - 1, 1 - (2 * (y - frame.top)) / frame.height);
  }

  /** Take the surface at a place of the view for the pivot, or that in its middle. */
  private grasp(place: Vector2): void {
    for (const at of [place, CENTRE]) {
      const ray = this.ray(at);
      const met = this.surfaces.meet(ray);
      if (met === null) continue;
      this.turnAbout(ray.at(met.distance, new Vector3()));
      return;
    }
    this.pivot.copy(this.controls.target);
  }

  private readonly wheeled = (event: WheelEvent): void => {
    event.preventDefault();
    const unit = event.deltaMode === 1 ? LINE_PX : event.deltaMode === 2 ? PAGE_PX : 1;
    // a pinch on a touchpad comes as a wheel with Ctrl, in small steps
    const notches = (event.deltaY * unit * (event.ctrlKey ? 5 : 1)) / NOTCH_PX;
    this.zoom(NOTCH ** -notches, this.inView(event.clientX, event.clientY));
  };

  /** Two fingers zoom; OrbitControls pans with them. */
  private readonly fingered = (event: PointerEvent): void => {
    const place = new Vector2(event.clientX, event.clientY);
    if (event.type === "pointerdown") {
      if (event.pointerType === "touch") this.fingers.set(event.pointerId, place);
      const [one, two] = [...this.fingers.values()];
      const middle = two === undefined ? place : one.clone().lerp(two, 0.5);
      this.grasp(this.inView(middle.x, middle.y));
      return;
    }
    if (event.type !== "pointermove") {
      this.fingers.delete(event.pointerId);
      return;
    }
    if (!this.fingers.has(event.pointerId)) return;
    const apart = this.apart();
    this.fingers.set(event.pointerId, place);
    const [one, two] = [...this.fingers.values()];
    if (two === undefined || this.fingers.size !== 2 || apart === 0 || this.apart() === 0) return;
    this.zoom(this.apart() / apart, this.inView((one.x + two.x) / 2, (one.y + two.y) / 2));
  };

  /** Distance between two fingers. */
  private apart(): number {
    const [one, two] = [...this.fingers.values()];
    return two === undefined ? 0 : one.distanceTo(two);
  }
}
