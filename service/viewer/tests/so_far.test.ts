import { describe, expect, it } from "vitest";
import { boxAround, pathOf, ringsOf, united } from "../src/models/plan";

const square = [
  [10, 20],
  [14, 20],
  [14, 25],
  [10, 20],
] as const;

describe("outlines of buildings so far", () => {
  it("takes the rings of polygons and multipolygons, and none of a building without an outline", () => {
    const hole = square.map(([x, y]) => [x + 1, y + 1]);
    expect(ringsOf({ type: "Polygon", coordinates: [square, hole] })).toEqual([square, hole]);
    expect(ringsOf({ type: "MultiPolygon", coordinates: [[square], [hole]] })).toEqual([square, hole]);
    expect(ringsOf(null)).toEqual([]);
  });

  it("draws north up, from an origin near by", () => {
    expect(pathOf([square], ([x, y]) => [x - 10, 20 - y], 2)).toBe("M0.00 0.00L4.00 0.00L4.00 -5.00L0.00 0.00Z");
  });

  it("grows its bounds with each building", () => {
    expect(boxAround(square)).toEqual([10, 20, 14, 25]);
    expect(united([[0, 22, 12, 23], boxAround(square)])).toEqual([0, 20, 14, 25]);
    expect(united([boxAround([]), [0, 22, 12, 23]])).toEqual([0, 22, 12, 23]);
  });
});
