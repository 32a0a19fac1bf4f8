/** Geometry in plan: rings, areas and boxes. */

import type { Feature } from "../api/types";

/** A place in plan, in the coordinates of its footprint. */
export type Point = readonly [number, number];

/** x_min, y_min, x_max, y_max. */
export type Box = readonly [number, number, number, number];

/** The polygons of a footprint: each its outer ring, then its holes. A ring repeats its first place at the end. */
export function polygonsOf(geometry: Feature["geometry"] | undefined): Point[][][] {
  if (geometry?.type === "Polygon") return [geometry.coordinates as Point[][]];
  return geometry?.type === "MultiPolygon" ? (geometry.coordinates as Point[][][]) : [];
}

/** The outer rings and holes of a footprint. */
export const ringsOf = (geometry: Feature["geometry"]): Point[][] => polygonsOf(geometry).flat();

/** Rings as the path of an SVG; `place` is where a point is drawn. */
export function pathOf(rings: readonly (readonly Point[])[], place: (point: Point) => Point, digits = 1): string {
  const words = (point: Point): string => place(point).map((value) => value.toFixed(digits)).join(" ");
  return rings.map((ring) => `M${ring.map(words).join("L")}Z`).join("");
}

/** Area of a ring, closed or not; negative for one that runs clockwise. */
export function areaOf(ring: readonly Point[]): number {
  // relative to the first place: far from the origin the products would lose the digits that matter
  const [x, y] = ring[0] ?? [0, 0];
  const twice = ring.reduce((sum, [ax, ay], i) => {
    const [bx, by] = ring[(i + 1) % ring.length];
    return sum + (ax - x) * (by - y) - (bx - x) * (ay - y);
  }, 0);
  return twice / 2;
}

/** The box around places; an empty one, from infinity to minus infinity, around none. */
export function boxAround(places: Iterable<readonly number[]>): Box {
  const box: [number, number, number, number] = [Infinity, Infinity, -Infinity, -Infinity];
  for (const [x, y] of places) {
    box[0] = Math.min(box[0], x);
    box[1] = Math.min(box[1], y);
    box[2] = Math.max(box[2], x);
    box[3] = Math.max(box[3], y);
  }
  return box;
}

/** The box around boxes. */
export function united(boxes: readonly Box[]): Box {
  return boxes.reduce(
    ([a, b, c, d], [x0, y0, x1, y1]) => [Math.min(a, x0), Math.min(b, y0), Math.max(c, x1), Math.max(d, y1)],
    boxAround([]),
  );
}
