import { expect, it } from "vitest";
import { Rows } from "../src/results/rows";

const rows = new Rows([50, 68, 50, 50, 68]);

it("lie one below the other", () => {
  expect(rows.height).toBe(286);
  expect([0, 1, 2, 3, 4].map((row) => [rows.top(row), rows.bottom(row)])).toEqual([
    [0, 50],
    [50, 118],
    [118, 168],
    [168, 218],
    [218, 286],
  ]);
});

it("are found by a place, which may be beyond the ends", () => {
  for (let place = 0; place < 286; place++) {
    const row = rows.at(place);
    expect(rows.top(row)).toBeLessThanOrEqual(place);
    expect(rows.bottom(row)).toBeGreaterThan(place);
  }
  expect(rows.at(-10)).toBe(0);
  expect(rows.at(1e6)).toBe(4);
});

it("of a window are all that meet it, and some more on both sides", () => {
  expect(rows.within(60, 120, 0)).toEqual([1, 3]);
  expect(rows.within(60, 120, 1)).toEqual([0, 4]);
  expect(rows.within(0, 1e6, 3)).toEqual([0, 5]);
});

it("of an empty list are none", () => {
  const none = new Rows([]);
  expect(none.height).toBe(0);
  expect(none.within(0, 800, 6)).toEqual([0, 0]);
});
