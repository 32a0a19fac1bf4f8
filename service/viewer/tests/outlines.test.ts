import { describe, expect, it } from "vitest";
import type { Feature } from "../src/api/types";
import { Batcher } from "../src/models/batching";
import { SequenceReader } from "../src/models/cityjson";
import { flatOutlines } from "../src/models/failed_footprints";
import { GABLE, METADATA } from "./gable";

const FRAME = { origin: [565_000, 5_934_000, 90] as const, horizontalUnitM: 1, verticalUnitM: 1 };

function areaOf(xy: ArrayLike<number>): number {
  let twice = 0;
  for (let i = 0, j = xy.length - 2; i < xy.length; j = i, i += 2) twice += xy[j] * xy[i + 1] - xy[i] * xy[j + 1];
  return twice / 2;
}

describe("outlines", () => {
  it("of a model are its ground surface, counter-clockwise", () => {
    const reader = new SequenceReader();
    reader.read(JSON.stringify(METADATA));
    const house = reader.read(JSON.stringify(GABLE));
    if (house === null) throw new Error("no building was read");
    const batcher = new Batcher(FRAME);
    batcher.add(house);
    const { outlines } = batcher.take();
    expect(outlines.map(({ id, category, rings }) => [id, category, rings.length])).toEqual([["house", "gable", 1]]);
    expect(outlines[0].rings[0]).toHaveLength(8);
    expect(areaOf(outlines[0].rings[0])).toBeCloseTo(60, 3);
    expect(batcher.take()).toEqual({ batches: [], listed: [], outlines: [] });
  });

  it("of an object without a model are its polygon, whose holes run clockwise", () => {
    const [x, y] = [565_000, 5_934_000];
    const square = (low: number, high: number): number[][] =>
      [[low, low], [low, high], [high, high], [high, low], [low, low]].map(([east, north]) => [x + east, y + north]);
    for (const rings of [[square(0, 10), square(2, 4)], [square(0, 10).reverse(), square(2, 4).reverse()]]) {
      const features: Feature[] = [
        { type: "Feature", geometry: { type: "Polygon", coordinates: rings }, properties: { object_id: "yard" } },
        { type: "Feature", geometry: null, properties: { object_id: "nowhere" } },
      ];
      const { batches, outlines } = flatOutlines(features, "rejected", FRAME, () => 2);
      expect(batches.map(({ category, listed }) => [category, listed.map(({ id }) => id)])).toEqual([["rejected", ["yard"]]]);
      expect(batches[0].boxes[2]).toBeCloseTo(2.25, 5);
      expect(outlines.map(({ id, category, rings }) => [id, category, rings.length])).toEqual([["yard", "rejected", 2]]);
      expect(areaOf(outlines[0].rings[0])).toBeCloseTo(100, 3);
      expect(areaOf(outlines[0].rings[1])).toBeCloseTo(-4, 3);
    }
  });
});
