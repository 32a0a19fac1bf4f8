import { describe, expect, it } from "vitest";
import type { Feature } from "../src/api/types";
import { georeference, mercatorOf, pairsOf } from "../src/map/georeference";
import type { Point as Xy } from "../src/models/plan";

const EARTH_M = 6_378_137;

/** Degrees of a place in metres around 9.997 east, 53.56 north: a plane turned by 2 degrees that bends with the sphere. */
function degreesOf([x, y]: Xy): Xy {
  const turn = (2 * Math.PI) / 180;
  const [u, v] = [x * Math.cos(turn) - y * Math.sin(turn), x * Math.sin(turn) + y * Math.cos(turn)];
  const latitude = 53.56 + ((v - (u * u * Math.tan((53.56 * Math.PI) / 180)) / (2 * EARTH_M)) / EARTH_M) * (180 / Math.PI);
  return [9.997 + (u / (EARTH_M * Math.cos((latitude * Math.PI) / 180))) * (180 / Math.PI), latitude];
}

function house(id: string, x: number, y: number, reversed = false): { native: Feature; degrees: Feature } {
  const ring: Xy[] = [[x, y], [x + 12, y], [x + 12, y + 7], [x, y + 7], [x, y]];
  const feature = (coordinates: Xy[]): Feature => ({ type: "Feature", id, geometry: { type: "Polygon", coordinates: [coordinates] }, properties: {} });
  const turned = ring.map(degreesOf);
  return { native: feature(ring), degrees: feature(reversed ? turned.reverse() : turned) };
}

/** Fit to houses in a square of this size. */
function fit(sizeM: number, n: number, reversed = false): ReturnType<typeof georeference> {
  const houses = Array.from({ length: n }, (_, i) => house(`h${i}`, ((i * 37) % 100) * (sizeM / 100), ((i * 59) % 100) * (sizeM / 100), reversed));
  const pairs = pairsOf(houses.map(({ native }) => native), houses.map(({ degrees }) => degrees).reverse(), (place) => place);
  expect(pairs).toHaveLength(4 * n);
  return georeference(pairs);
}

describe("the place of the map on Earth", () => {
  it("is exact to a decimetre over ten kilometres, and back", () => {
    const found = fit(10_000, 60);
    expect(found?.errorM).toBeLessThan(0.1);
    for (const place of [[0, 0], [10_000, 0], [5000, 9000], [-500, 10_500]] as Xy[]) {
      const [x, y] = found?.toPlane(mercatorOf(degreesOf(place))) ?? [];
      expect(Math.hypot((x ?? NaN) - place[0], (y ?? NaN) - place[1])).toBeLessThan(0.3);
      const back = found?.toPlane(found.toMercator(place)) ?? [];
      expect(Math.hypot((back[0] ?? NaN) - place[0], (back[1] ?? NaN) - place[1])).toBeLessThan(0.3);
    }
  });

  it("is found from one house, and from rings that were turned around", () => {
    expect(fit(10, 1)?.errorM).toBeLessThan(0.01);
    expect(fit(2000, 20, true)?.errorM).toBeLessThan(0.05);
  });

  it("is not found without places, or from a line", () => {
    expect(georeference([])).toBeNull();
    const line = Array.from({ length: 9 }, (_, i): Xy => [10 * i, 20 * i]);
    expect(georeference(line.map((place) => ({ plane: place, mercator: mercatorOf(degreesOf(place)) })))).toBeNull();
  });

  it("says how far off it is", () => {
    const pairs = pairsOf([house("a", 0, 0).native, house("b", 90, 50).native], [house("a", 0, 0).degrees, house("b", 90, 50).degrees], (place) => place);
    pairs[2].plane = [pairs[2].plane[0] + 5, pairs[2].plane[1]];
    expect(georeference(pairs)?.errorM).toBeGreaterThan(1);
  });
});

describe("Web Mercator", () => {
  it("is the square that tiles divide", () => {
    expect(mercatorOf([0, 0])).toEqual([0.5, 0.5]);
    expect(mercatorOf([-180, 0])[0]).toBe(0);
    expect(mercatorOf([0, 85.0511287798066])[1]).toBeCloseTo(0, 9);
    // the numbers of a tile by the other formula in use
    const [x, y] = mercatorOf([9.97, 53.54]).map((value) => Math.floor(value * 2 ** 17));
    expect([x, y]).toEqual([Math.floor((189.97 / 360) * 2 ** 17), Math.floor(((1 - Math.asinh(Math.tan((53.54 * Math.PI) / 180)) / Math.PI) / 2) * 2 ** 17)]);
  });
});
