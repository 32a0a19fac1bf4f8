/** Which building a ray hits: boxes first, then the triangles of the buildings whose box is hit. */

import { Box3, Vector3, type Ray } from "three";

/** The part of a batch that a ray can hit. */
export interface Pickable {
  boxes: Float32Array;
  positions: Float32Array;
  starts: Uint32Array;
  /** 1 for each building that is shown; missing if all are. */
  shown?: Uint8Array;
}

export interface Hit<T extends Pickable> {
  batch: T;
  /** Number of the building within its batch. */
  index: number;
  distance: number;
  /** First corner of the triangle that was hit. */
  corner: number;
}

/** The box around a building of a batch. */
export function boxOf({ boxes }: Pickable, index: number, box = new Box3()): Box3 {
  box.min.fromArray(boxes, 6 * index);
  box.max.fromArray(boxes, 6 * index + 3);
  return box;
}

/**
 * The first building that a ray hits; null if it hits none.
 *
 * @param fromOutside Faces that are met from their inner side are passed over.
 */
export function pick<T extends Pickable>(batches: Iterable<T>, ray: Ray, fromOutside = false): Hit<T> | null {
  const [box, met] = [new Box3(), new Vector3()];
  const corners = [new Vector3(), new Vector3(), new Vector3()] as const;
  let best: Hit<T> | null = null;
  for (const batch of batches) {
    for (let index = 0; index + 1 < batch.starts.length; index++) {
      if (batch.shown?.[index] === 0 || ray.intersectBox(boxOf(batch, index, box), met) === null) continue;
      const entry = box.containsPoint(ray.origin) ? 0 : met.distanceTo(ray.origin);
      if (entry >= (best?.distance ?? Infinity)) continue;
      for (let corner = batch.starts[index]; corner < batch.starts[index + 1]; corner += 3) {
        corners.forEach((place, n) => place.fromArray(batch.positions, 3 * (corner + n)));
        // corners run counter-clockwise as seen from outside
        if (ray.intersectTriangle(...corners, fromOutside, met) === null) continue;
        const distance = met.distanceTo(ray.origin);
        if (distance > 0 && distance < (best?.distance ?? Infinity)) best = { batch, index, distance, corner };
      }
    }
  }
  return best;
}

/** Distance from a point to the nearest box of shown buildings; 0 within one, infinity without boxes. */
export function boxDistance(batches: Iterable<Pickable>, point: Vector3): number {
  const box = new Box3();
  let nearest = Infinity;
  for (const batch of batches) {
    for (let index = 0; 6 * index < batch.boxes.length; index++) {
      if (batch.shown?.[index] !== 0) nearest = Math.min(nearest, boxOf(batch, index, box).distanceToPoint(point));
    }
  }
  return nearest;
}
