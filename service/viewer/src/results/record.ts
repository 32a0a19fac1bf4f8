/** The record of one object, beside the models. */

import { buildingOf, getJson, type Run } from "../api/requests";
import type { Feature } from "../api/types";
import { dossierLink, followDossier } from "../dossier/dossier_link";
import { downloadLink } from "../jobs/downloads";
import type { Listed } from "../models/batching";
import { COLUMN_NAMES, COLUMNS, shown } from "../models/columns";
import { FIGURES, figureWords, type FigureName } from "../models/figures";
import { el, swatch } from "../page/elements";
import { report, warningNotice } from "../page/notices";
import { bareTable, facts, type Column } from "../page/tables";
import { capital, reasonWords } from "../words/fields";
import { measure } from "../words/numbers";
import { CATEGORIES, categoryOf, type Category } from "../words/roof_types";

type Properties = Feature["properties"];

/**
 * Show the record of one building; returns a function that stops the loading.
 *
 * @param elevationUnitM Metres per unit of the elevations in it.
 */
export function showRecord(place: HTMLElement, run: Run, id: string, elevationUnitM: number): () => void {
  const calledOff = new AbortController();
  const { signal } = calledOff;
  const load = (): void => {
    place.replaceChildren(el("p", { class: "loading" }, "Loading…"));
    getJson<Feature>(buildingOf(run, id), { signal, headers: { Accept: "application/geo+json" } }).then(
      ({ properties }) => {
        if (signal.aborted) return;
        place.replaceChildren(...record(properties, id, elevationUnitM), ...takeAway(properties, run, id));
      },
      (error: unknown) => {
        if (!signal.aborted) report(place, error, load);
      },
    );
  };
  load();
  followDossier(run, id, signal);
  return () => calledOff.abort();
}

const isModelled = ({ status }: Properties): boolean => status === "ok" || status === "doubtful" || status === "fallback";

function heading(category: Category, words: string, id: string): HTMLElement {
  return el("div", { class: "record-head" }, el("h2", {}, swatch(category), words), el("code", { class: "record-id", title: id }, id));
}

function record(properties: Properties, id: string, elevationUnitM: number): HTMLElement[] {
  const { status, reason, reason_detail: detail, lod, valid } = properties;
  const category = categoryOf(status, properties["roof_type"]);
  const modelled = isModelled(properties);
  const roof = ["doubtful", "fallback", "failed"].includes(category) ? "" : " roof";
  const marks: [string, string, boolean][] = [
    ["mark-plain", `LoD${String(lod)}`, typeof lod === "string"],
    ["mark-good", "valid solid", modelled && valid === true],
    ["mark-bad", "not valid", modelled && valid !== true],
    ["mark-plain", "curved roof", properties["is_curved"] === true],
    ["mark-warn", "at the edge of the data", properties["touches_data_edge"] === true],
  ];
  const hasReason = typeof reason === "string" && reason !== "";
  const codes = Array.isArray(properties["validity_codes"]) ? properties["validity_codes"] : [];
  const parts = [
    heading(category, category === "unknown" ? "Other roof" : CATEGORIES[category].label + roof, id),
    el("ul", { class: "marks" }, ...marks.filter(([, , isThere]) => isThere).map(([kind, words]) => el("li", { class: kind }, words))),
    hasReason ? warningNotice(`${capital(reasonWords(reason))}${typeof detail === "string" && detail !== "" ? `: ${detail}` : "."}`) : null,
    el("div", { class: "record-links" }, dossierLink()),
    codes.length > 0 ? el("p", { class: "hint" }, `Codes of the method's own solid: ${codes.join(", ")}`) : null,
    ...sections(properties, elevationUnitM),
    planes(properties["planes"]),
  ];
  return parts.filter((part) => part !== null);
}

/** The most important columns of the record, by section; the file has all of them. */
function sections(properties: Properties, elevationUnitM: number): HTMLElement[] {
  return [...new Set(COLUMN_NAMES.map((name) => COLUMNS[name].section))].map((section) => {
    const names = COLUMN_NAMES.filter((name) => COLUMNS[name].section === section);
    const rows = names.map((name) => [COLUMNS[name].label, shown(name, properties[name], elevationUnitM)] as const);
    return el("section", {}, el("h3", {}, section), facts({}, ...rows));
  });
}

const PLANE_FIGURES = [
  ["Slope", "slope_deg", 1, "°"],
  ["Aspect", "aspect_deg", 0, "°"],
  ["Area", "area_m2", 1, "m²"],
  ["RMSE", "rmse_m", 3, "m"],
] as const;

/** Slope and aspect of each roof plane. */
function planes(value: unknown): HTMLElement | null {
  if (!Array.isArray(value) || value.length === 0) return null;
  const columns = PLANE_FIGURES.map(([head, name, digits, unit]): Column<Properties> => ({
    head,
    cell: (plane) => measure(plane[name], digits, unit),
  }));
  return el("section", {}, el("h3", {}, "Roof planes"), bareTable({}, columns, value as Properties[]));
}

/** Downloads of one building; a job has meshes of one kind, or none. */
function takeAway(properties: Properties, run: Run, id: string): HTMLElement[] {
  if (!isModelled(properties)) return [];
  const path = properties["mesh_path"];
  const kinds = typeof path === "string" ? [path.slice(path.lastIndexOf(".") + 1)] : [];
  const links = [...kinds.map((kind) => [kind.toUpperCase(), kind]), ["CityJSON", "cityjson"]];
  return [el("div", { class: "record-links" }, ...links.map(([label, kind]) => downloadLink(label, buildingOf(run, id, `?f=${kind}`))))];
}

const OF_REJECTED: [FigureName, string][] = [
  ["height", FIGURES.height.label],
  ["area", FIGURES.area.label],
  ["points", FIGURES.points.label],
  ["confidence", "Confidence that it is a building"],
];

/** What is known about an object that was left out. */
export function rejectedRecord({ id, reason, reasonDetail, figures }: Listed): HTMLElement[] {
  const why = reason === null ? "No reason is recorded" : capital(reasonWords(reason));
  const rows = OF_REJECTED.map(([name, label]) => [label, figureWords(name, figures) ?? "–"] as const);
  return [
    heading("rejected", "Not a building", id),
    warningNotice(reasonDetail === null ? `${why}.` : `${why} (${reasonDetail}).`),
    el("section", {}, el("h3", {}, "What was measured"), facts({}, ...rows)),
    el(
      "section",
      { class: "hint" },
      "The outline is the box around the object. If it is a building, give this id with the action accept in an overrides file to a run on the command line.",
    ),
  ];
}
