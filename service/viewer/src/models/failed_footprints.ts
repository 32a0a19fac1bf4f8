import type { Feature } from "../api/types";
import { Batcher, type Gathered } from "./batching";
import type { SceneFrame } from "./building_mesh";
import type { Face } from "./cityjson";
import { areaOf, polygonsOf } from "./plan";

const ABOVE_GROUND_M = 0.25;

/**
 * Outlines of objects without a model, as flat faces on the ground, and the objects as they are listed.
 *
 * @param status The status of all of them: failed or rejected.
 */
export function flatOutlines(
  features: readonly Feature[],
  status: "failed" | "rejected",
  frame: SceneFrame,
  groundAt: (x: number, y: number) => number,
): Gathered {
  const batcher = new Batcher({ origin: [0, 0, 0], horizontalUnitM: 1, verticalUnitM: 1 });
  for (const { geometry, properties, id } of features) {
    const name = properties["building_id"] ?? properties["object_id"] ?? id;
    if (typeof name !== "string") continue;
    const vertices: [number, number, number][] = [];
    const faces = polygonsOf(geometry).map((polygon): Face => {
      // GeoJSON repeats the first position at the end
      const rings = polygon.map((ring) =>
        ring.slice(0, -1).map(([easting, northing]) => {
          const x = (easting - frame.origin[0]) * frame.horizontalUnitM;
          const y = (northing - frame.origin[1]) * frame.horizontalUnitM;
          return vertices.push([x, y, groundAt(x, y) + ABOVE_GROUND_M]) - 1;
        }),
      );
      // many writers ignore RFC 7946
      if (areaOf(polygon[0] ?? []) < 0) for (const ring of rings) ring.reverse();
      return { kind: "roof", rings };
    });
    // a face must be planar
    const top = vertices.reduce((highest, [, , z]) => Math.max(highest, z), -Infinity);
    const level = Float64Array.from(vertices.flatMap(([x, y]) => [x, y, top]));
    batcher.add({ id: name, attributes: { ...properties, status }, vertices: level, faces, levels: [] });
  }
  return batcher.take();
}
