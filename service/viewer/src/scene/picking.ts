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

type Vector = readonly [number, number, number];

/**
 * The first building that a ray hits; null if it hits none.
 *
 * Boxes first, then the triangles of the buildings whose box is hit (Möller and Trumbore 1997).
 *
 * @param fromOutside Faces that are met from their inner side are passed over.
 */
export function pick<T extends Pickable>(
  batches: Iterable<T>,
  origin: Vector,
  direction: Vector,
  fromOutside = false,
): Hit<T> | null {
  let best: Hit<T> | null = null;
  for (const batch of batches) {
    for (let index = 0; index + 1 < batch.starts.length; index++) {
      if (batch.shown?.[index] === 0) continue;
      const entry = boxEntry(batch.boxes, 6 * index, origin, direction);
      if (entry >= (best?.distance ?? Infinity)) continue;
      for (let corner = batch.starts[index]; corner < batch.starts[index + 1]; corner += 3) {
        const distance = triangleDistance(batch.positions, 3 * corner, origin, direction, fromOutside);
        if (distance < (best?.distance ?? Infinity)) best = { batch, index, distance, corner };
      }
    }
  }
  return best;
}

/** Distance from a point to the nearest box of shown buildings; 0 within one, infinity without boxes. */
export function boxDistance(batches: Iterable<Pickable>, point: Vector): number {
  let nearest = Infinity;
  for (const { boxes, shown } of batches) {
    for (let at = 0; at < boxes.length; at += 6) {
      if (shown?.[at / 6] === 0) continue;
      let squared = 0;
      for (let axis = 0; axis < 3; axis++) {
        const beyond = Math.max(boxes[at + axis] - point[axis], point[axis] - boxes[at + axis + 3], 0);
        squared += beyond * beyond;
      }
      nearest = Math.min(nearest, squared);
    }
  }
  return Math.sqrt(nearest);
}

/** Distance at which the ray enters the box, 0 from inside it, infinity if it misses. */
function boxEntry(boxes: Float32Array, at: number, origin: Vector, direction: Vector): number {
  let enter = 0;
  let leave = Infinity;
  for (let axis = 0; axis < 3; axis++) {
    const low = boxes[at + axis] - origin[axis];
    const high = boxes[at + axis + 3] - origin[axis];
    if (direction[axis] === 0) {
      if (low > 0 || high < 0) return Infinity;
      continue;
    }
    const [a, b] = [low / direction[axis], high / direction[axis]];
    enter = Math.max(enter, Math.min(a, b));
    leave = Math.min(leave, Math.max(a, b));
  }
  return enter <= leave ? enter : Infinity;
}

function triangleDistance(
  p: Float32Array,
  at: number,
  origin: Vector,
  direction: Vector,
  fromOutside: boolean,
): number {
  const [dx, dy, dz] = direction;
  const [e1x, e1y, e1z] = [p[at + 3] - p[at], p[at + 4] - p[at + 1], p[at + 5] - p[at + 2]];
  const [e2x, e2y, e2z] = [p[at + 6] - p[at], p[at + 7] - p[at + 1], p[at + 8] - p[at + 2]];
  const [px, py, pz] = [dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x];
  const determinant = e1x * px + e1y * py + e1z * pz;
  // corners run counter-clockwise as seen from outside: the determinant is positive there
  if (determinant === 0 || (fromOutside && determinant < 0)) return Infinity;
  const [tx, ty, tz] = [origin[0] - p[at], origin[1] - p[at + 1], origin[2] - p[at + 2]];
  const u = (tx * px + ty * py + tz * pz) / determinant;
  if (u < 0 || u > 1) return Infinity;
  const [qx, qy, qz] = [ty * e1z - tz * e1y, tz * e1x - tx * e1z, tx * e1y - ty * e1x];
  const v = (dx * qx + dy * qy + dz * qz) / determinant;
  if (v < 0 || u + v > 1) return Infinity;
  const distance = (e2x * qx + e2y * qy + e2z * qz) / determinant;
  return distance > 0 ? distance : Infinity;
}
