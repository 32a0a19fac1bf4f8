import type { Feature } from "../api/types";

/** A place in plan, in the coordinates of its footprint. */
export type Point = readonly [number, number];

/** The outer rings and holes of a footprint. */
export function ringsOf(geometry: Feature["geometry"]): Point[][] {
  if (geometry === null) return [];
  const polygons = (geometry.type === "MultiPolygon" ? geometry.coordinates : [geometry.coordinates]) as Point[][][];
  return polygons.flat();
}
