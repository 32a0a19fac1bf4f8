/** What a result says before its objects. */

import type { RunReport } from "../api/types";
import { buildingWords } from "../jobs/job_words";
import type { RunObjects } from "../models/run_objects";
import { STATUSES } from "../models/selection";
import { dropDown } from "../page/action_menu";
import { el } from "../page/elements";
import { warningNotice } from "../page/notices";
import { capital } from "../words/fields";
import { count, counted, duration } from "../words/numbers";

/** The facts of a run in one line: what was found, from how many points, in what time. */
export function resultFacts({ report, counts, listed }: RunObjects): (string | HTMLElement)[] {
  const tally = report.counts ?? {};
  const rejected = tally["rejected"];
  const points = tally["points"];
  const seconds = report.timings_s?.["total"];
  const warnings = report.warnings ?? [];
  const crsName = report.crs?.name ?? "unknown";
  const of = (status: keyof typeof STATUSES): number =>
    STATUSES[status].categories.reduce((n, category) => n + (counts.get(category) ?? 0), 0);
  const statuses = { ok: of("ok"), doubtful: of("doubtful"), fallback: of("fallback"), failed: of("failed") };
  const facts = [
    listed.length > 0 ? buildingWords(statuses) : null,
    rejected === undefined ? null : `${count(rejected)} other objects left out`,
    points === undefined ? null : `${count(points)} points`,
    seconds === undefined ? null : duration(seconds),
    crsName === "unknown" ? "CRS unknown" : crsName,
  ]
    .filter((fact) => fact !== null)
    .join(" · ");
  const notice = dropDown(el("summary", {}, counted(warnings.length, "warning")), el("div", {}, warningNotice(...warnings)), "menu-warnings");
  const headline = report.headline ?? "";
  return [headline === "" ? "" : warningNotice(capital(headline)), facts, warnings.length === 0 ? "" : " · ", warnings.length === 0 ? "" : notice];
}

/** Say what to try if the result is empty. */
export function nothingFound(report: RunReport): HTMLElement {
  const rejected = report.counts?.["rejected"] ?? 0;
  return el(
    "div",
    { class: "card" },
    el("h2", {}, "No building was found"),
    el(
      "p",
      {},
      rejected > 0
        ? `${counted(rejected, "object")} ${rejected === 1 ? "was" : "were"} looked at and left out: too small, too low, too narrow, or vegetation. Each is in the list under “Without a model”, and in the download “rejected”, with its reason and the measured figure.`
        : capital(report.headline || "Nothing rises above the ground."),
    ),
    el(
      "ul",
      {},
      el("li", {}, "Is the vertical unit right? Feet read as metres, or metres as feet, shift every threshold."),
      el("li", {}, "Does the file use its own class codes? Try “Classes: ignore”."),
      el("li", {}, "Do the points reach roofs and walls? Less than about one point per m² is too few."),
      el("li", {}, "If you have footprints, add them: they say where to look."),
    ),
  );
}
