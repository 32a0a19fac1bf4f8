import { expect, test } from "vitest";
import type { Listed } from "../src/models/batching";
import { makersNote, pairs, type Placed } from "../src/models/pairing";

type Plan = [number, number, number, number];

function placed(id: string, plan: Plan | null, more: Partial<Listed> = {}): Placed {
  const listed = { id, category: "gable", reason: null, reasonDetail: null, figures: { height: 6, area: 80 }, ...more } as Listed;
  return { listed, plan };
}

const short = (found: ReturnType<typeof pairs>): string[] =>
  found.map(({ change, old, new: now }) => `${change} ${old?.id ?? "-"} ${now?.id ?? "-"}`).sort();

test("buildings with one id belong together, wherever they are drawn", () => {
  expect(short(pairs([placed("a", [0, 0, 10, 8])], [placed("a", null)]))).toEqual(["same a a"]);
});

test("other buildings belong together by their plans, the best overlap first", () => {
  const old = [placed("a", [0, 0, 10, 10]), placed("b", [100, 0, 110, 10])];
  const now = [placed("x", [4, 0, 14, 10]), placed("y", [1, 0, 11, 10]), placed("z", [-60, 0, -50, 10])];
  expect(short(pairs(old, now))).toEqual(["divided - x", "gone b -", "new - z", "same a y"]);
  expect(short(pairs([...old].reverse(), [...now].reverse()))).toEqual(short(pairs(old, now)));
});

test("plans on both sides of a cell's border are found", () => {
  expect(short(pairs([placed("a", [45, -5, 55, 5])], [placed("b", [46, -5, 56, 5])]))).toEqual(["same a b"]);
});

test("a row that was modelled as one building is divided otherwise, not new", () => {
  const parts = [placed("p", [0, 0, 20, 8]), placed("q", [20, 0, 30, 8])];
  expect(short(pairs([placed("row", [0, 0, 30, 8])], parts))).toEqual(["divided - q", "same row p"]);
  expect(short(pairs(parts, [placed("row", [0, 0, 30, 8])]))).toEqual(["divided q -", "same p row"]);
});

test("differences from their limits on are named with both values", () => {
  const found = pairs(
    [placed("a", null), placed("b", null), placed("c", null), placed("d", null, { figures: { area: 80 } })],
    [
      placed("a", null, { category: "hip", figures: { height: 9.04, area: 120 } }),
      placed("b", null, { figures: { height: 6.5, area: 83.9 } }),
      placed("c", null, { figures: { height: 6.49, area: 83.9 } }),
      placed("d", null, { figures: { height: 6, area: 84 } }),
    ],
  );
  const differences = Object.fromEntries(found.map((pair) => [pair.old?.id, pair.differences]));
  expect(differences["a"]).toEqual(["Gable → Hip", "height 6.0 → 9.0\u202fm", "footprint 80 → 120\u202fm²"]);
  expect(differences["b"]).toEqual(["height 6.0 → 6.5\u202fm"]);
  expect(differences["c"]).toEqual([]);
  expect(differences["d"]).toEqual(["footprint 80 → 84\u202fm²"]);
});

test("a failed building without a counterpart has nothing at its place", () => {
  expect(short(pairs([placed("a", null)], []))).toEqual(["gone a -"]);
  expect(short(pairs([], []))).toEqual([]);
});

test("another version or other settings are named with what they mean for shapes", () => {
  const maker = { engine_version: "0.2.0", method: "arrangement", settings_hash: "ab" };
  const meaning = "Outlines and roofs may be drawn anew where nothing was built.";
  expect(makersNote(maker, maker)).toBe("");
  expect(makersNote(maker, { ...maker, engine_version: "0.3.0" })).toBe(`The versions differ: left is of 0.2.0, right of 0.3.0. ${meaning}`);
  expect(makersNote(maker, { ...maker, settings_hash: "cd" })).toBe(`The settings differ. ${meaning}`);
  expect(makersNote(maker, { ...maker, method: "kmeans", settings_hash: "cd" })).toBe("");
});
