/** Which buildings of two runs belong together, and what differs between them. No drawing, no service. */

import type { RunReport } from "../api/types";
import { measure } from "../words/numbers";
import { CATEGORIES } from "../words/roof_types";
import type { Listed } from "./batching";

/** A building of one run with its plan: west, south, east, north in metres, in the frame of both runs. */
export interface Placed {
  listed: Listed;
  /** Null if nothing of it is drawn. */
  plan: readonly [number, number, number, number] | null;
}

export type Change = "changed" | "new" | "gone" | "divided" | "same";

/** Buildings that belong together, or one without a counterpart. */
export interface Pair {
  change: Change;
  old: Listed | null;
  new: Listed | null;
  /** What differs, in words. */
  differences: string[];
}

/** Colours of the changes, from the palette of Okabe and Ito (2008), and their words. */
export const CHANGES: Record<Change, { label: string; colour: string; words: string }> = {
  changed: { label: "Changed", colour: "#e69f00", words: "another roof, height or footprint" },
  new: { label: "New", colour: "#0072b2", words: "nothing is at its place on the left" },
  gone: { label: "Gone", colour: "#d55e00", words: "nothing is at its place on the right" },
  divided: { label: "Divided otherwise", colour: "#cc79a7", words: "the other side has its place as part of another building" },
  same: { label: "Same", colour: "#b9c1c9", words: "no difference above the limits" },
};

/** Differences below these are not reported: heights in metres, footprints as a share and in square metres. */
export const LIMITS = { heightM: 0.5, areaShare: 0.05, areaM2: 2 } as const;

/** What differs between what made two runs of one method, and what that means for shapes; empty if nothing does. */
export function makersNote(old: RunReport, now: RunReport): string {
  const versions = [old, now].map(({ engine_version }) => engine_version ?? "an unknown version");
  const ofVersions = versions[0] === versions[1] ? "" : `The versions differ: left is of ${versions.join(", right of ")}. `;
  const ofSettings = old.method === now.method && old.settings_hash !== now.settings_hash ? "The settings differ. " : "";
  return ofVersions + ofSettings && `${ofVersions}${ofSettings}Outlines and roofs may be drawn anew where nothing was built.`;
}

const MIN_OVERLAP = 0.3; // of what both plans cover together
const MOSTLY = 0.5; // of a plan: then its place is not empty on the other side
const CELL_M = 50;

/** Bring the buildings of two runs together: by id where both have it, then by the overlap of their plans. */
export function pairs(old: readonly Placed[], now: readonly Placed[]): Pair[] {
  const found: Pair[] = [];
  const byId = new Map(now.map((one) => [one.listed.id, one]));
  const restOld: Placed[] = [];
  const taken = new Set<Placed>();
  for (const one of old) {
    const other = byId.get(one.listed.id);
    if (other === undefined) restOld.push(one);
    else {
      taken.add(other);
      found.push(pairOf(one.listed, other.listed));
    }
  }
  const restNew = now.filter((one) => !taken.has(one));
  const matched = byOverlap(restOld, restNew);
  for (const [one, other] of matched) found.push(pairOf(one.listed, other.listed));
  const used = new Set(matched.flat());
  const [near, nearOld] = [new Grid(now), new Grid(old)];
  for (const one of restOld) if (!used.has(one)) found.push(alone(one, "gone", near));
  for (const one of restNew) if (!used.has(one)) found.push(alone(one, "new", nearOld));
  return found;
}

function byOverlap(old: readonly Placed[], now: readonly Placed[]): [Placed, Placed][] {
  const grid = new Grid(now);
  const candidates = old.flatMap((one) =>
    grid.near(one).flatMap((other) => {
      const share = overlap(one, other) / (area(one) + area(other) - overlap(one, other));
      return share >= MIN_OVERLAP ? [{ one, other, share }] : [];
    }),
  );
  // the best first; equal ones in an order that does not depend on that of the files
  candidates.sort((a, b) => b.share - a.share || compare(a.one.listed.id, b.one.listed.id) || compare(a.other.listed.id, b.other.listed.id));
  const used = new Set<Placed>();
  return candidates.flatMap(({ one, other }): [Placed, Placed][] => {
    if (used.has(one) || used.has(other)) return [];
    used.add(one).add(other);
    return [[one, other]];
  });
}

function alone(one: Placed, change: "new" | "gone", others: Grid): Pair {
  const covered = others.near(one).reduce((sum, other) => sum + overlap(one, other), 0);
  const isDivided = area(one) > 0 && covered >= MOSTLY * area(one);
  const [before, after] = change === "gone" ? [one.listed, null] : [null, one.listed];
  return { change: isDivided ? "divided" : change, old: before, new: after, differences: [] };
}

function pairOf(old: Listed, now: Listed): Pair {
  const differences: string[] = [];
  if (old.category !== now.category) differences.push(`${CATEGORIES[old.category].label} → ${CATEGORIES[now.category].label}`);
  const [before, after] = [old.figures, now.figures];
  if (before.height !== undefined && after.height !== undefined && Math.abs(after.height - before.height) >= LIMITS.heightM) {
    differences.push(`height ${measure(before.height, 1)} → ${measure(after.height, 1, "m")}`);
  }
  if (before.area !== undefined && after.area !== undefined) {
    const by = Math.abs(after.area - before.area);
    if (by >= LIMITS.areaM2 && by >= LIMITS.areaShare * before.area) {
      differences.push(`footprint ${measure(before.area, 0)} → ${measure(after.area, 0, "m²")}`);
    }
  }
  return { change: differences.length > 0 ? "changed" : "same", old, new: now, differences };
}

/** Finds the buildings near a plan without a look at all of them. */
class Grid {
  private readonly cells = new Map<string, Placed[]>();

  constructor(all: readonly Placed[]) {
    for (const one of all) {
      for (const cell of cellsOf(one)) {
        const there = this.cells.get(cell);
        if (there === undefined) this.cells.set(cell, [one]);
        else there.push(one);
      }
    }
  }

  near(one: Placed): Placed[] {
    return [...new Set(cellsOf(one).flatMap((cell) => this.cells.get(cell) ?? []))];
  }
}

function cellsOf({ plan }: Placed): string[] {
  if (plan === null) return [];
  const [west, south, east, north] = plan.map((value) => Math.floor(value / CELL_M)) as [number, number, number, number];
  const cells: string[] = [];
  for (let x = west; x <= east; x++) for (let y = south; y <= north; y++) cells.push(`${x} ${y}`);
  return cells;
}

const area = ({ plan }: Placed): number => (plan === null ? 0 : (plan[2] - plan[0]) * (plan[3] - plan[1]));

function overlap({ plan: a }: Placed, { plan: b }: Placed): number {
  if (a === null || b === null) return 0;
  return Math.max(0, Math.min(a[2], b[2]) - Math.max(a[0], b[0])) * Math.max(0, Math.min(a[3], b[3]) - Math.max(a[1], b[1]));
}

const compare = (a: string, b: string): number => (a < b ? -1 : a > b ? 1 : 0);
