import { expect, test } from "vitest";
import { problemOf } from "../src/api";
import { bytes, count, counted, duration, measure } from "../src/numbers";
import { CATEGORIES, categoryOf } from "../src/roof_types";

test("numbers are grouped and carry their unit", () => {
  expect(count(1234567)).toBe("1\u202f234\u202f567");
  expect(counted(1, "building")).toBe("1 building");
  expect(counted(0, "building")).toBe("0 buildings");
  expect(measure(1969.44, 1, "m²")).toBe("1\u202f969.4\u202fm²");
  expect(measure(-0.04, 1, "m")).toBe("0.0\u202fm");
  expect(measure(-3.25, 2)).toBe("−3.25");
  expect(measure(null, 2, "m")).toBe("–");
  expect(bytes(999)).toBe("999\u202fB");
  expect(bytes(4_300_000_000)).toBe("4.3\u202fGB");
  expect(duration(200)).toBe("3\u202fmin 20\u202fs");
});

test("a building that is not ok is described by its status, whatever its roof type", () => {
  expect(categoryOf("ok", "hip")).toBe("hip");
  expect(categoryOf("fallback", "flat")).toBe("fallback");
  expect(categoryOf("failed", "none")).toBe("failed");
  expect(categoryOf("ok", "onion")).toBe("unknown");
});

test("no two categories share a colour", () => {
  const colours = Object.values(CATEGORIES).map(({ colour }) => colour);
  expect(new Set(colours).size).toBe(colours.length);
});

test("a problem document is shown with what to do, anything else with its status", () => {
  const refused = problemOf(413, "", '{"title":"Too large","detail":"9 GB, 4 GB are taken"}', null);
  expect([refused.title, refused.detail]).toEqual(["Too large", "9 GB, 4 GB are taken"]);
  expect(refused.remedy).toContain("Split the tile");
  expect(problemOf(429, "Too Many Requests", "<html>", "7").remedy).toBe("Try again in 7 seconds.");
  expect(problemOf(502, "Bad Gateway", "", null).title).toBe("Bad Gateway");
  expect(problemOf(500, "", "null", null).title).toBe("Status 500");
});
