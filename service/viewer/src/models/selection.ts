/** Which objects of a result are shown, and in which order; the address holds it, so a link shows the same. */

import { reasonWords } from "../words/fields";
import { CATEGORIES, CATEGORY_NAMES, type Category } from "../words/roof_types";
import type { Listed } from "./batching";
import { FIGURE_NAMES, FLAG_NAMES, type FigureName, type Flag } from "./figures";

export const SORTS = ["problems", "id", "roof", "reason", ...FIGURE_NAMES] as const;

/** `problems`: objects without a model first, then doubtful models, then fallback blocks, then the largest area. */
export type Sort = (typeof SORTS)[number];

/** Bounds of a figure in the record's unit, both included; null for none. */
export type Range = readonly [number | null, number | null];

export interface Wanted {
  /** Words that must all be found in the id, the id of the given footprint, or the reason. */
  text: string;
  hidden: ReadonlySet<Category>;
  /** Any of these reasons; empty for all objects, also those without a reason. */
  reasons: ReadonlySet<string>;
  /** All of these marks. */
  flags: ReadonlySet<Flag>;
  ranges: ReadonlyMap<FigureName, Range>;
  sort: Sort;
  descending: boolean;
  /** The map in place of the 3D view. */
  map: boolean;
}

/** Everything that has become a building; objects that were left out are not shown. */
export const USUAL: Wanted = {
  text: "",
  hidden: new Set<Category>(["rejected"]),
  reasons: new Set(),
  flags: new Set(),
  ranges: new Map(),
  sort: "problems",
  descending: false,
  map: false,
};

/** Whether something is filtered: not all buildings are shown, or more than buildings. */
export function isFiltered(wanted: Wanted): boolean {
  return addressed({ ...wanted, sort: USUAL.sort, descending: false, map: false }).size > 0;
}

/** The same order and view without any filter. */
export function unfiltered({ sort, descending, map }: Wanted): Wanted {
  return { ...USUAL, sort, descending, map };
}

// --- the address

const OWN = ["q", "hide", "show", "reason", "mark", "sort", "view", ...FIGURE_NAMES];

/** The parameters of an address that say what is shown; none for the usual. */
export function addressed(wanted: Wanted): URLSearchParams {
  const given = new URLSearchParams();
  const put = (name: string, value: string): void => {
    if (value !== "") given.set(name, value);
  };
  put("q", wanted.text.trim());
  put("hide", CATEGORY_NAMES.filter((name) => name !== "rejected" && wanted.hidden.has(name)).join(","));
  put("show", wanted.hidden.has("rejected") ? "" : "rejected");
  put("reason", [...wanted.reasons].sort().join(","));
  put("mark", FLAG_NAMES.filter((name) => wanted.flags.has(name)).join(","));
  for (const name of FIGURE_NAMES) {
    const [least, most] = wanted.ranges.get(name) ?? [null, null];
    if (least !== null || most !== null) put(name, `${least ?? ""}..${most ?? ""}`);
  }
  if (wanted.sort !== USUAL.sort || wanted.descending) put("sort", `${wanted.descending ? "-" : ""}${wanted.sort}`);
  put("view", wanted.map ? "map" : "");
  return given;
}

/** What an address asks for; what it misspells is left out. */
export function wantedOf(given: URLSearchParams): Wanted {
  const list = (name: string): string[] => (given.get(name) ?? "").split(",").filter((word) => word !== "");
  const hidden = new Set(CATEGORY_NAMES.filter((name) => list("hide").includes(name)));
  if (!list("show").includes("rejected")) hidden.add("rejected");
  const ranges = new Map<FigureName, Range>();
  for (const name of FIGURE_NAMES) {
    const range = rangeOf(given.get(name) ?? "");
    if (range !== null) ranges.set(name, range);
  }
  const sort = given.get("sort") ?? "";
  const named = SORTS.find((name) => name === sort.replace(/^-/, ""));
  return {
    text: given.get("q") ?? "",
    hidden,
    reasons: new Set(list("reason")),
    flags: new Set(FLAG_NAMES.filter((name) => list("mark").includes(name))),
    ranges,
    sort: named ?? USUAL.sort,
    descending: named !== undefined && sort.startsWith("-"),
    map: given.get("view") === "map",
  };
}

/** The query of an address with these parameters in place of its own of that kind; others stay. */
export function queryWith(query: string, wanted: Wanted): string {
  const all = new URLSearchParams(query);
  for (const name of OWN) all.delete(name);
  for (const [name, value] of addressed(wanted)) all.set(name, value);
  // commas are legal there, and easier to read
  return all.toString().replaceAll("%2C", ",");
}

function rangeOf(text: string): Range | null {
  const parts = text.split("..");
  if (parts.length !== 2) return null;
  const [least, most] = parts.map((part) => (part === "" ? null : Number(part)));
  if (Number.isNaN(least) || Number.isNaN(most) || (least === null && most === null)) return null;
  return [least ?? null, most ?? null];
}

// --- what it selects

/** Whether an object is shown. */
export function fits(wanted: Wanted, object: Listed): boolean {
  return !wanted.hidden.has(object.category) && fitsRest(wanted, object);
}

/** The same whatever its category: what the tallies of the categories count. */
function fitsRest(wanted: Wanted, object: Listed): boolean {
  if (wanted.reasons.size > 0 && (object.reason === null || !wanted.reasons.has(object.reason))) return false;
  for (const flag of wanted.flags) if (!object.flags.includes(flag)) return false;
  for (const [name, [least, most]] of wanted.ranges) {
    const value = object.figures[name];
    if (value === undefined || (least !== null && value < least) || (most !== null && value > most)) return false;
  }
  return saysAll(object, wordsOf(wanted.text));
}

function wordsOf(text: string): string[] {
  return text.toLowerCase().split(/\s+/).filter((word) => word !== "");
}

function saysAll({ id, sourceId, reason }: Listed, words: readonly string[]): boolean {
  if (words.length === 0) return true;
  const text = `${id} ${sourceId ?? ""} ${reason === null ? "" : reasonWords(reason)}`.toLowerCase();
  return words.every((word) => text.includes(word));
}

/** The shown objects in their order. */
export function selected(objects: readonly Listed[], wanted: Wanted): Listed[] {
  return objects.filter((object) => fits(wanted, object)).sort(orderOf(wanted));
}

const WEIGHTS: Partial<Record<Category, number>> = { failed: 0, rejected: 1, doubtful: 2, fallback: 3 };
const LARGER_THAN_ALL_M2 = 1e9;

/** What objects are sorted by; null for one that does not have it. */
function keyOf(sort: Sort, { id, category, reason, figures }: Listed): string | number | null {
  switch (sort) {
    case "problems":
      return (WEIGHTS[category] ?? 4) * LARGER_THAN_ALL_M2 - (figures.area ?? 0);
    case "id":
      return id;
    case "roof":
      return CATEGORY_NAMES.indexOf(category);
    case "reason":
      return reason;
    default:
      return figures[sort] ?? null;
  }
}

/** Compares two objects; those without the figure come last in both directions, and ties follow the ids. */
function orderOf({ sort, descending }: Wanted): (a: Listed, b: Listed) => number {
  const compare = (a: string | number, b: string | number): number => (a < b ? -1 : a > b ? 1 : 0);
  return (a, b) => {
    const [first, second] = [keyOf(sort, a), keyOf(sort, b)];
    const isEither = first === null || second === null;
    const order = isEither ? Number(first === null) - Number(second === null) : compare(first, second) * (descending ? -1 : 1);
    return order || compare(a.id, b.id);
  };
}

/** Number of objects of each category and of each reason that the other filters let through. */
export function tallies(
  objects: readonly Listed[],
  wanted: Wanted,
): { categories: Map<Category, number>; reasons: Map<string, number> } {
  const anyReason = { ...wanted, reasons: new Set<string>() };
  const listed = objects.filter((object) => fits(anyReason, object)).map(({ reason }) => reason);
  return {
    categories: countOf(objects.filter((object) => fitsRest(wanted, object)).map(({ category }) => category)),
    reasons: countOf(listed.filter((reason) => reason !== null)),
  };
}

/** How often each of these is among them. */
export function countOf<T>(all: readonly T[]): Map<T, number> {
  const counts = new Map<T, number>();
  for (const one of all) counts.set(one, (counts.get(one) ?? 0) + 1);
  return counts;
}

/** The categories of a status, in the words of the page. */
export const STATUSES = {
  ok: { label: "Modelled", categories: CATEGORY_NAMES.slice(0, CATEGORY_NAMES.indexOf("doubtful")) },
  doubtful: { label: CATEGORIES.doubtful.label, categories: ["doubtful"] as Category[] },
  fallback: { label: CATEGORIES.fallback.label, categories: ["fallback"] as Category[] },
  failed: { label: CATEGORIES.failed.label, categories: ["failed"] as Category[] },
  rejected: { label: CATEGORIES.rejected.label, categories: ["rejected"] as Category[] },
};
