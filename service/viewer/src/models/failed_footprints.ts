import type { Feature } from "../api/types";
import { Batcher, type Batch } from "./batching";
import type { SceneFrame } from "./building_mesh";
import type { Face } from "./cityjson";
import type { Outlines } from "./outlines";

const ABOVE_GROUND_M = 0.25;

/**
 * Outlines of objects without a model, as flat faces on the ground.
 *
 * @param status The status of all of them: failed or rejected.
 */
export function flatOutlines(
  features: readonly Feature[],
  status: "failed" | "rejected",
  frame: SceneFrame,
  groundAt: (x: number, y: number) => number,
): { batches: Batch[]; outlines: Outlines } {
  const batcher = new Batcher({ origin: [0, 0, 0], horizontalUnitM: 1, verticalUnitM: 1 });
  for (const { geometry, properties, id } of features) {
    const name = properties["building_id"] ?? properties["object_id"] ?? id;
    if (typeof name !== "string") continue;
    const vertices: number[] = [];
    const faces: Face[] = polygonsOf(geometry).map((rings) => ({
      kind: "roof",
      rings: rings.map((ring) =>
        // GeoJSON repeats the first position at the end
        ring.slice(0, -1).map(([easting, northing]) => {
          const x = (easting - frame.origin[0]) * frame.horizontalUnitM;
          const y = (northing - frame.origin[1]) * frame.horizontalUnitM;
          vertices.push(x, y, groundAt(x, y) + ABOVE_GROUND_M);
          return vertices.length / 3 - 1;
        }),
      ),
    }));
    level(vertices);
    for (const { rings } of faces) if (seenFromBelow(vertices, rings[0] ?? [])) rings.forEach((ring) => ring.reverse());
    batcher.add({ id: name, attributes: { status, reason: properties["reason"] }, vertices: Float64Array.from(vertices), faces, levels: [] });
  }
  return { batches: batcher.take(), outlines: batcher.takeOutlines() };
}

type Ring = [number, number][];

function polygonsOf(geometry: Feature["geometry"]): Ring[][] {
  if (geometry?.type === "Polygon") return [geometry.coordinates as Ring[]];
  if (geometry?.type === "MultiPolygon") return geometry.coordinates as Ring[][];
  return [];
}

/** Whether a ring runs clockwise: many writers ignore RFC 7946. */
function seenFromBelow(vertices: readonly number[], ring: readonly number[]): boolean {
  let area = 0;
  ring.forEach((from, i) => {
    const to = ring[(i + 1) % ring.length];
    area += vertices[3 * from] * vertices[3 * to + 1] - vertices[3 * to] * vertices[3 * from + 1];
  });
  return area < 0;
}

/** Lift all vertices to the highest one: a face must be planar. */
function level(vertices: number[]): void {
  let top = -Infinity;
  for (let i = 2; i < vertices.length; i += 3) top = Math.max(top, vertices[i]);
  for (let i = 2; i < vertices.length; i += 3) vertices[i] = top;
}
