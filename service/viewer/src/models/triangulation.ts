import { Earcut } from "three/src/extras/Earcut.js";

export type Normal = readonly [number, number, number];

/**
 * Normal of a ring by Newell's sums, of length 1; a ring without area gives 0, 0, 0.
 *
 * The sums run over differences to the first vertex: coordinates of six and seven digits would lose small areas to rounding.
 */
export function ringNormal(vertices: Float64Array, ring: readonly number[]): Normal {
  let nx = 0;
  let ny = 0;
  let nz = 0;
  const o = 3 * ring[0];
  for (let i = 1; i + 1 < ring.length; i++) {
    const a = 3 * ring[i];
    const b = 3 * ring[i + 1];
    const ax = vertices[a] - vertices[o];
    const ay = vertices[a + 1] - vertices[o + 1];
    const az = vertices[a + 2] - vertices[o + 2];
    const bx = vertices[b] - vertices[o];
    const by = vertices[b + 1] - vertices[o + 1];
    const bz = vertices[b + 2] - vertices[o + 2];
    nx += ay * bz - az * by;
    ny += az * bx - ax * bz;
    nz += ax * by - ay * bx;
  }
  const length = Math.hypot(nx, ny, nz);
  return length > 0 ? [nx / length, ny / length, nz / length] : [0, 0, 0];
}

/**
 * Triangles of a planar face with holes, as indices into the vertices, with the orientation of the outer ring.
 *
 * @param rings The outer ring first; holes turn the other way round.
 * @param normal Of the outer ring; a face without area gives no triangles.
 */
export function triangulate(vertices: Float64Array, rings: readonly (readonly number[])[], normal: Normal): number[] {
  const outer = rings[0] ?? [];
  if (outer.length < 3 || (normal[0] === 0 && normal[1] === 0 && normal[2] === 0)) return [];
  if (outer.length === 3 && rings.length === 1) return [...outer];
  // projected along the axis nearest to the normal, from the side that keeps the orientation
  const axis = nearestAxis(normal);
  const u = (axis + 1) % 3;
  const v = (axis + 2) % 3;
  const side = Math.sign(normal[axis]);
  const cross = (a: number, b: number, c: number): number => {
    const [p, q, r] = [3 * a, 3 * b, 3 * c];
    const along = (vertices[q + u] - vertices[p + u]) * (vertices[r + v] - vertices[p + v]);
    return side * (along - (vertices[q + v] - vertices[p + v]) * (vertices[r + u] - vertices[p + u]));
  };
  if (outer.length === 4 && rings.length === 1) {
    const [a, b, c, d] = outer;
    if (cross(a, b, c) > 0 && cross(b, c, d) > 0 && cross(c, d, a) > 0 && cross(d, a, b) > 0) return [a, b, c, a, c, d];
  }
  const index = rings.flat();
  const holes: number[] = [];
  let begin = outer.length;
  for (const ring of rings.slice(1)) {
    holes.push(begin);
    begin += ring.length;
  }
  const o = 3 * outer[0];
  const flat = index.flatMap((i) => [vertices[3 * i + u] - vertices[o + u], vertices[3 * i + v] - vertices[o + v]]);
  const triangles = Earcut.triangulate(flat, holes, 2).map((i) => index[i]);
  for (let i = 0; i < triangles.length; i += 3) {
    if (cross(triangles[i], triangles[i + 1], triangles[i + 2]) >= 0) continue;
    [triangles[i + 1], triangles[i + 2]] = [triangles[i + 2], triangles[i + 1]];
  }
  return triangles;
}

function nearestAxis(normal: Normal): number {
  const [x, y, z] = normal.map(Math.abs);
  if (z >= x && z >= y) return 2;
  return y >= x ? 1 : 0;
}
