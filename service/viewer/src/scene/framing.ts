import { Box3, Vector3 } from "three";

/**
 * The place from which boxes just fill the frame of a perspective camera.
 *
 * @param boxes At least one.
 * @param toCamera Unit vector from the target to the camera; not straight up.
 * @param tanV Tangent of half the vertical field of view.
 * @param aspect Width over height.
 * @returns The point to look at, and the distance from it along `toCamera`.
 */
export function framing(
  boxes: readonly Box3[],
  toCamera: Vector3,
  tanV: number,
  aspect: number,
): { target: Vector3; distance: number } {
  const right = new Vector3().crossVectors(new Vector3(0, 0, 1), toCamera).normalize();
  const up = new Vector3().crossVectors(toCamera, right);
  const [across, along] = [new Span(right, toCamera, tanV * aspect), new Span(up, toCamera, tanV)];
  const whole = new Box3();
  const point = new Vector3();
  for (const box of boxes) {
    whole.union(box);
    for (let corner = 0; corner < 8; corner++) {
      point.set(
        (corner & 1 ? box.max : box.min).x,
        (corner & 2 ? box.max : box.min).y,
        (corner & 4 ? box.max : box.min).z,
      );
      across.take(point);
      along.take(point);
    }
  }
  const depth = whole.getCenter(new Vector3()).dot(toCamera);
  const target = new Vector3()
    .addScaledVector(right, across.middle)
    .addScaledVector(up, along.middle)
    .addScaledVector(toCamera, depth);
  return { target, distance: Math.max(across.distance, along.distance) - depth };
}

/**
 * The place of a camera on one of its axes that brings all points into its frame.
 *
 * A point p is left of the right border when (p - c)·axis <= tan (c - p)·forward: the border's constraint is linear in
 * the camera's place c, and the tightest constraint of each side gives both its middle and its minimum distance.
 */
class Span {
  private high = -Infinity;
  private low = -Infinity;

  constructor(
    private readonly axis: Vector3,
    private readonly forward: Vector3,
    private readonly tan: number,
  ) {}

  take(point: Vector3): void {
    const [aside, near] = [point.dot(this.axis), this.tan * point.dot(this.forward)];
    this.high = Math.max(this.high, near + aside);
    this.low = Math.max(this.low, near - aside);
  }

  get middle(): number {
    return (this.high - this.low) / 2;
  }

  get distance(): number {
    return (this.high + this.low) / (2 * this.tan);
  }
}
