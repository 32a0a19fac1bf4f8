/** Schedules as the service shows them, in words. */

import type { ScheduleRun } from "../api/types";
import { counted } from "../words/numbers";

/** What became of a time, in the words of the page. */
export const outcomeWords = (outcome: string): string => (outcome === "submitted" ? "started" : outcome);

/** How a run came about, or how many times were missed together. */
export function slotWords({ trigger, slots, moreSlots }: ScheduleRun): string {
  if (trigger === "hand") return "by hand";
  return slots === 1 && moreSlots !== true ? "" : `${moreSlots === true ? "at least " : ""}${counted(slots, "time")} together`;
}

/** `12 started, 1 skipped`; those of which there are none are left out. */
export function countWords(counts: Readonly<Record<string, number>>): string {
  return Object.entries(counts)
    .filter(([, number]) => number > 0)
    .map(([outcome, number]) => `${number} ${outcomeWords(outcome)}`)
    .join(", ");
}

/** The day and the minute of a time on the clock of a zone; on the clock of UTC if the browser does not know the zone. */
export function clockWords(time: string, zone: string): string {
  try {
    return clock(time, zone);
  } catch {
    return `${clock(time, "UTC")} UTC`;
  }
}

function clock(time: string, timeZone: string): string {
  const at = new Date(time);
  // Sweden writes its times as ISO 8601 does
  const day = at.toLocaleString("sv-SE", { timeZone, dateStyle: "short", timeStyle: "short" });
  return `${at.toLocaleDateString("en-GB", { timeZone, weekday: "short" })} ${day}`;
}

/** The usual times, for those who do not write cron. */
export const USUAL: Record<string, string> = {
  "30 2 * * *": "every night at 02:30",
  "0 * * * *": "every hour",
  "30 2 * * 1": "every Monday at 02:30",
  "30 2 1 * *": "on the first of each month at 02:30",
};

/** The files of a request, as lines of text. */
export function tileLines(inputs: Readonly<Record<string, unknown>>): string {
  const tiles = Array.isArray(inputs["tiles"]) ? inputs["tiles"] : [];
  return tiles.map((tile) => (tile as { href?: string }).href ?? "").filter((href) => href !== "").join("\n");
}

/** The inputs with the files of these lines. */
export function withTiles(inputs: Readonly<Record<string, unknown>>, lines: string): Record<string, unknown> {
  const tiles = lines.split("\n").map((line) => line.trim()).filter((line) => line !== "").map((href) => ({ href }));
  return { ...inputs, tiles };
}
