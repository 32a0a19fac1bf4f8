import { expect, test } from "vitest";
import { levelShown, levelsOffered, levelWords, lodsInput } from "../src/models/levels_of_detail";

const SETS = ["1.2", "1.3", "2.0", "2.2", "1.2,1.3", "1.2,2.2", "1.3,2.2", "2.0,2.2", "1.2,1.3,2.2", "1.2,1.3,2.0,2.2"]; // some of the process description

test("of the sets that the process takes each level is offered once, coarse to fine", () => {
  expect(levelsOffered(SETS)).toEqual(["1.2", "1.3", "2.0", "2.2"]);
  expect(levelsOffered([...SETS].reverse())).toEqual(["1.2", "1.3", "2.0", "2.2"]);
  for (const lod of levelsOffered(SETS)) expect(levelWords(lod)).not.toBe("");
});

test("what is chosen is one of the sets that the process takes, in whatever order it was chosen", () => {
  expect(lodsInput(["2.2"])).toBe("2.2");
  expect(lodsInput(["2.2", "1.2", "1.3", "1.2"])).toBe("1.2,1.3,2.2");
  for (const set of SETS) expect(SETS).toContain(lodsInput(set.split(",").reverse()));
  expect(lodsInput(["2.2", "2.0"])).toBe("2.0,2.2");
  expect(lodsInput([])).toBe("");
});

test("what is shown is the finest level that is no finer than the one that is asked for", () => {
  expect(levelShown(["2.2", "1.2"], null)).toBe("2.2");
  expect(levelShown(["2.2", "1.2"], "1.3")).toBe("1.2");
  expect(levelShown(["2.2", "1.3"], "1.2")).toBeNull();
  expect(levelShown([], null)).toBeNull();
});
