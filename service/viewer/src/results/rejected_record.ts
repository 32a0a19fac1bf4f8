import type { Listed } from "../models/batching";
import { FIGURES, figureWords, type FigureName } from "../models/figures";
import { el, swatch } from "../page/elements";
import { warningNotice } from "../page/notices";
import { capital } from "../words/fields";
import { reasonWords } from "../words/reasons";

const SHOWN: [FigureName, string][] = [
  ["height", FIGURES.height.label],
  ["area", FIGURES.area.label],
  ["points", FIGURES.points.label],
  ["confidence", "Confidence that it is a building"],
];

/** What is known about an object that was left out. */
export function rejectedRecord({ id, reason, reasonDetail, figures }: Listed): HTMLElement[] {
  const why = reason === null ? "No reason is recorded" : capital(reasonWords(reason));
  return [
    el(
      "div",
      { class: "record-head" },
      el("h2", {}, swatch("rejected"), "Not a building"),
      el("code", { class: "record-id", title: id }, id),
    ),
    warningNotice(reasonDetail === null ? `${why}.` : `${why} (${reasonDetail}).`),
    el(
      "section",
      {},
      el("h3", {}, "What was measured"),
      el(
        "dl",
        {},
        ...SHOWN.flatMap(([name, label]) => [el("dt", {}, label), el("dd", {}, figureWords(name, figures) ?? "–")]),
      ),
    ),
    el(
      "section",
      { class: "hint" },
      "The outline is the box around the object. If it is a building, give this id with the action accept in an overrides file to a run on the command line.",
    ),
  ];
}
