import { expect, test } from "vitest";
import { ringNormal, triangulate } from "../src/models/triangulation";

/** Twice the signed area of the triangles, seen along the normal. */
function area(vertices: Float64Array, triangles: number[], normal: readonly number[]): number {
  let sum = 0;
  for (let i = 0; i < triangles.length; i += 3) {
    const [a, b, c] = triangles.slice(i, i + 3).map((v) => [...vertices.slice(3 * v, 3 * v + 3)]);
    const [p, q] = [b.map((x, k) => x - a[k]), c.map((x, k) => x - a[k])];
    const cross = [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
    sum += cross.reduce((s, x, k) => s + x * normal[k], 0) / 2;
  }
  return sum;
}

/** The points of a plan polygon on the plane z = x / 2 - y / 4, far from the origin as real coordinates are. */
function onPlane(plan: [number, number][]): Float64Array {
  return Float64Array.from(plan.flatMap(([x, y]) => [565000 + x, 5934000 + y, 90 + x / 2 - y / 4]));
}

const SLANT = Math.hypot(1, 0.5, 0.25); // true area over plan area
const L_SHAPE: [number, number][] = [[0, 0], [10, 0], [10, 4], [4, 4], [4, 10], [0, 10]];

test("a concave face keeps its area and its turn, however it is turned", () => {
  const vertices = onPlane(L_SHAPE);
  const up = L_SHAPE.map((_, i) => i);
  for (const ring of [up, [...up].reverse()]) {
    const normal = ringNormal(vertices, ring);
    expect(Math.sign(normal[2])).toBe(ring === up ? 1 : -1);
    expect(area(vertices, triangulate(vertices, [ring], normal), normal)).toBeCloseTo(64 * SLANT, 6);
  }
});

test("a hole is left out", () => {
  const vertices = onPlane([[0, 0], [10, 0], [10, 10], [0, 10], [3, 3], [3, 6], [6, 6], [6, 3]]);
  const normal = ringNormal(vertices, [0, 1, 2, 3]);
  const triangles = triangulate(vertices, [[0, 1, 2, 3], [4, 5, 6, 7]], normal);
  expect(area(vertices, triangles, normal)).toBeCloseTo((100 - 9) * SLANT, 6);
});

test("an upright wall is triangulated in its own plane", () => {
  const vertices = Float64Array.from([0, 0, 0, 6, 0, 0, 6, 0, 3, 3, 0, 5, 0, 0, 3]);
  const normal = ringNormal(vertices, [0, 1, 2, 3, 4]);
  expect([...normal]).toEqual([0, -1, 0]);
  expect(area(vertices, triangulate(vertices, [[0, 1, 2, 3, 4]], normal), normal)).toBeCloseTo(24, 9);
});

test("a concave quadrilateral is not cut across its notch", () => {
  const vertices = onPlane([[0, 0], [4, 0], [1, 1], [0, 4]]);
  const normal = ringNormal(vertices, [0, 1, 2, 3]);
  const triangles = triangulate(vertices, [[0, 1, 2, 3]], normal);
  expect(area(vertices, triangles, normal)).toBeCloseTo(4 * SLANT, 6);
  for (let i = 0; i < triangles.length; i += 3) expect(area(vertices, triangles.slice(i, i + 3), normal)).toBeGreaterThan(0);
});

test("a face without area gives nothing", () => {
  const vertices = Float64Array.from([0, 0, 0, 1, 0, 0, 2, 0, 0]);
  expect(triangulate(vertices, [[0, 1, 2]], ringNormal(vertices, [0, 1, 2]))).toEqual([]);
});
