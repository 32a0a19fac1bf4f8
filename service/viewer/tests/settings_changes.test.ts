import { expect, test } from "vitest";
import type { SettingSchema } from "../src/api/types";
import { changes, flat, known, rangeWords } from "../src/jobs/settings_changes";
import { textOf, valueOf } from "../src/page/form_fields";

const SCHEMA: SettingSchema = {
  properties: {
    tile_size_m: { type: "number", default: 0, minimum: 0, maximum: 2000 },
    candidates: { properties: { min_area_m2: { type: "number", default: 5 }, listed: { type: "boolean", default: true } } },
  },
};

test("settings of tables are named by table and name", () => {
  expect([...known(SCHEMA).keys()]).toEqual(["tile_size_m", "candidates.min_area_m2", "candidates.listed"]);
  expect([...flat({ tile_size_m: 500, candidates: { min_area_m2: 15 }, codes: [2, 6] })]).toEqual([
    ["tile_size_m", 500],
    ["candidates.min_area_m2", 15],
    ["codes", [2, 6]],
  ]);
});

test("only what differs is sent, in tables; null takes a setting away", () => {
  const before = flat({ tile_size_m: 500, candidates: { min_area_m2: 15, min_height_m: 2 }, roof: { codes: [1, 2] } });
  const after = flat({ candidates: { min_area_m2: 20, min_height_m: 2, min_width_m: 1 }, roof: { codes: [1, 2] } });
  expect(changes(before, after)).toEqual({ tile_size_m: null, candidates: { min_area_m2: 20, min_width_m: 1 } });
  expect(changes(before, new Map(before))).toEqual({});
});

test("texts become values of the setting's type, and stay texts where they do not fit", () => {
  expect(valueOf(" 1.5 ", { type: "number" })).toBe(1.5);
  expect(valueOf("wide", { type: "number" })).toBe("wide");
  expect(valueOf("", { type: "number" })).toBe("");
  expect(valueOf("false", { type: "boolean" })).toBe(false);
  expect(valueOf("2, 6", { type: "array" })).toEqual([2, 6]);
  expect(valueOf("12", { type: "string" })).toBe("12");
  expect(textOf([2, 6])).toBe("2, 6");
});

test("the range of a setting is shown with its usual value", () => {
  expect(rangeWords({ minimum: 0.5, maximum: 100, default: 4 })).toBe("at least 0.5; at most 100; usually 4");
  expect(rangeWords({ enum: ["trust", "audit"], default: "trust" })).toBe("trust, audit; usually trust");
  expect(rangeWords({ minimum: 1 })).toBe("at least 1");
  expect(rangeWords({})).toBe("");
});
