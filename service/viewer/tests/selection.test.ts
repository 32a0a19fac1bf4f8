import { describe, expect, it } from "vitest";
import type { Listed } from "../src/models/batching";
import { figuresOf, figureWords, flagsOf } from "../src/models/figures";
import {
  addressed,
  isFiltered,
  queryWith,
  selected,
  SORTS,
  STATUSES,
  tallies,
  unfiltered,
  USUAL,
  wantedOf,
  type Wanted,
} from "../src/models/selection";
import { CATEGORY_NAMES, type Category } from "../src/words/roof_types";

function listed(id: string, category: Category, others: Partial<Listed> = {}): Listed {
  return { id, category, reason: null, reasonDetail: null, sourceId: null, figures: {}, flags: [], ...others };
}

const HOUSE = listed("house", "gable", { figures: { height: 8, area: 120, confidence: 0.97 }, sourceId: "G0503" });
const SHED = listed("shed", "flat", { figures: { height: 3, area: 20, confidence: 0.8 }, flags: ["edge"] });
const HALL = listed("hall", "flat", { figures: { height: 3, area: 900 }, flags: ["edge", "curved"] });
const BLOCK = listed("block", "fallback", { reason: "no_plane", figures: { area: 50 } });
const HOLE = listed("hole", "failed", { reason: "no_footprint" });
const TREE = listed("tree", "rejected", { reason: "vegetation", figures: { height: 12, area: 30 } });
const ALL = [HOUSE, SHED, HALL, BLOCK, HOLE, TREE];

const ids = (wanted: Partial<Wanted>): string[] => selected(ALL, { ...USUAL, ...wanted }).map(({ id }) => id);

describe("what is listed", () => {
  it("is usually all buildings, problems first, then the largest", () => {
    expect(ids({})).toEqual(["hole", "block", "hall", "house", "shed"]);
    expect(isFiltered(USUAL)).toBe(false);
  });

  it("follows the categories, the reasons, the marks and the ranges", () => {
    expect(ids({ hidden: new Set(["flat", "rejected"]) })).toEqual(["hole", "block", "house"]);
    expect(ids({ hidden: new Set(STATUSES.ok.categories) })).toEqual(["hole", "tree", "block"]);
    expect(ids({ reasons: new Set(["no_plane", "vegetation"]) })).toEqual(["block"]);
    expect(ids({ flags: new Set(["edge"]) })).toEqual(["hall", "shed"]);
    expect(ids({ flags: new Set(["edge", "curved"]) })).toEqual(["hall"]);
    expect(ids({ ranges: new Map([["height", [3, 8]]]) })).toEqual(["hall", "house", "shed"]);
    expect(ids({ ranges: new Map([["height", [3.1, null]]]) })).toEqual(["house"]);
    expect(ids({ ranges: new Map([["height", [null, 3]], ["area", [null, 100]]]) })).toEqual(["shed"]);
  });

  it("leaves out what does not have a figure that is asked for", () => {
    expect(ids({ ranges: new Map([["confidence", [0, null]]]) })).toEqual(["house", "shed"]);
  });

  it("is found by parts of the id, the given footprint's id, and the words of the reason", () => {
    expect(ids({ text: "hO" })).toEqual(["hole", "house"]);
    expect(ids({ text: "g05" })).toEqual(["house"]);
    expect(ids({ text: "outline points" })).toEqual(["hole"]);
    expect(ids({ text: " roof  plane " })).toEqual(["block"]);
    expect(ids({ text: "roof outline" })).toEqual([]);
  });
});

describe("the order", () => {
  it("puts what lacks the figure last in both directions", () => {
    expect(ids({ sort: "confidence" })).toEqual(["shed", "house", "block", "hall", "hole"]);
    expect(ids({ sort: "confidence", descending: true })).toEqual(["house", "shed", "block", "hall", "hole"]);
    expect(ids({ sort: "reason" }).slice(0, 2)).toEqual(["hole", "block"]);
    expect(ids({ sort: "reason", descending: true }).slice(0, 2)).toEqual(["block", "hole"]);
  });

  it("breaks ties by id, whatever the order of arrival", () => {
    for (const sort of SORTS) {
      const wanted = { ...USUAL, sort };
      expect(selected([...ALL].reverse(), wanted)).toEqual(selected(ALL, wanted));
    }
    expect(ids({ sort: "height" }).slice(0, 2)).toEqual(["hall", "shed"]);
    expect(ids({ sort: "height", descending: true }).slice(0, 3)).toEqual(["house", "hall", "shed"]);
  });
});

describe("the tallies", () => {
  it("count each category by the other filters, and each reason whatever reasons are chosen", () => {
    const wanted = { ...USUAL, hidden: new Set<Category>(["flat"]), reasons: new Set(["vegetation"]) };
    const { categories, reasons } = tallies(ALL, wanted);
    expect([...categories]).toEqual([["rejected", 1]]);
    expect(Object.fromEntries(reasons)).toEqual({ no_plane: 1, no_footprint: 1, vegetation: 1 });
    expect(tallies(ALL, USUAL).categories.get("flat")).toBe(2);
    expect(tallies(ALL, { ...USUAL, hidden: new Set<Category>(["flat"]) }).categories.get("flat")).toBe(2);
    expect(tallies(ALL, USUAL).reasons.has("vegetation")).toBe(false);
  });
});

describe("the address", () => {
  const wanted: Wanted = {
    text: "ab c,d&e",
    hidden: new Set<Category>(["gable", "failed"]),
    reasons: new Set(["vegetation", "too_low"]),
    flags: new Set(["edge"]),
    ranges: new Map([
      ["height", [3.5, null]],
      ["confidence", [null, 0.95]],
      ["area", [-1, 1e6]],
    ]),
    sort: "residual",
    descending: true,
    map: true,
  };

  it("says all that is shown, and brings it back", () => {
    expect(wantedOf(new URLSearchParams(queryWith("", wanted)))).toEqual(wanted);
    expect(wantedOf(new URLSearchParams(addressed(wanted)))).toEqual(wanted);
  });

  it("is short for the usual", () => {
    expect(queryWith("", USUAL)).toBe("");
    expect(wantedOf(new URLSearchParams())).toEqual(USUAL);
    expect(queryWith("", { ...USUAL, hidden: new Set(), ranges: new Map([["height", [3, 10]]]) })).toBe("show=rejected&height=3..10");
  });

  it("keeps what others put there", () => {
    expect(queryWith("camera=1&q=old&height=1..2", { ...USUAL, text: "new" })).toBe("camera=1&q=new");
  });

  it("ignores what it does not know", () => {
    expect(wantedOf(new URLSearchParams("hide=roof&mark=x&height=a..b&area=5&volume=..&sort=-size&view=globe"))).toEqual(USUAL);
  });

  it("without the filters keeps order and view", () => {
    expect(isFiltered(wanted)).toBe(true);
    expect(unfiltered(wanted)).toEqual({ ...USUAL, sort: "residual", descending: true, map: true });
  });
});

describe("the figures of a record", () => {
  it("are those that it has, whole numbers of 64 bits included", () => {
    const record = { height_m: 7.5, footprint_area_m2: null, n_planes: 2, rmse_m: NaN, n_points: 55n };
    expect(figuresOf(record)).toEqual({ height: 7.5, planes: 2, points: 55 });
    expect(figuresOf({ area_m2: 4, height_m: 2 })).toEqual({ area: 4, height: 2 });
  });

  it("are shown with their units", () => {
    expect(figureWords("confidence", { confidence: 0.975 })).toBe("97.5\u202f%");
    expect(figureWords("points", { points: 12_345 })).toBe("12\u202f345");
    expect(figureWords("height", {})).toBeNull();
  });

  it("come with its marks", () => {
    expect(flagsOf({ touches_data_edge: true, is_curved: false, validity_codes: [203], overridden: "" })).toEqual(["edge", "faults"]);
    expect(flagsOf({ is_curved: true, validity_codes: [], overridden: "method" })).toEqual(["curved", "overridden"]);
  });
});

it("every status names its categories once", () => {
  const named = Object.values(STATUSES).flatMap(({ categories }) => categories);
  expect([...named].sort()).toEqual([...CATEGORY_NAMES].sort());
});
