import { getJson, ofRun, type Problem } from "../api/requests";
import type { Feature } from "../api/types";
import { dossierLink, followDossier } from "../dossier/dossier_link";
import { downloadLink } from "../jobs/downloads";
import { COLUMN_NAMES, COLUMNS, shown } from "../models/columns";
import { el, swatch } from "../page/elements";
import { asProblem, problemNotice, warningNotice } from "../page/notices";
import { fact } from "../page/tables";
import { capital } from "../words/fields";
import { measure } from "../words/numbers";
import { reasonWords } from "../words/reasons";
import { CATEGORIES, categoryOf } from "../words/roof_types";

type Record_ = Feature["properties"];

/** The most important columns of the record, by section; the file has all of them. */
function tables(properties: Record_, elevationUnitM: number): HTMLElement[] {
  const sections = [...new Set(COLUMN_NAMES.map((name) => COLUMNS[name].section))];
  return sections.map((section) => {
    const names = COLUMN_NAMES.filter((name) => COLUMNS[name].section === section);
    const rows = names.flatMap((name) => fact(COLUMNS[name].label, shown(name, properties[name], elevationUnitM)));
    return el("section", {}, el("h3", {}, section), el("dl", {}, ...rows));
  });
}

/** Show the record of one building; returns a function that stops the loading. */
export function showRecord(
  place: HTMLElement,
  jobPath: string,
  method: string | null,
  buildingId: string,
  elevationUnitM: number,
  onProblem: (problem: Problem) => void,
): () => void {
  const calledOff = new AbortController();
  const path = `${jobPath}/buildings/${encodeURIComponent(buildingId)}`;
  const load = (): void => {
    place.replaceChildren(el("p", { class: "loading" }, "Loading…"));
    getJson<Feature>(ofRun(path, method), { signal: calledOff.signal, headers: { Accept: "application/geo+json" } }).then(
      ({ properties }) => {
        if (!calledOff.signal.aborted) place.replaceChildren(...record(properties, path, method, buildingId, elevationUnitM));
      },
      (error: unknown) => {
        if (calledOff.signal.aborted) return;
        const problem = asProblem(error);
        place.replaceChildren(problemNotice(problem, load));
        onProblem(problem);
      },
    );
  };
  load();
  followDossier(jobPath, method, buildingId, calledOff.signal);
  return () => calledOff.abort();
}

function record(
  properties: Record_,
  path: string,
  method: string | null,
  buildingId: string,
  elevationUnitM: number,
): HTMLElement[] {
  const { status, reason, reason_detail: detail, lod, valid } = properties;
  const category = categoryOf(status, properties["roof_type"]);
  const modelled = status === "ok" || status === "doubtful" || status === "fallback";
  const heading = el(
    "div",
    { class: "record-head" },
    el("h2", {}, swatch(category), category === "unknown" ? "Other roof" : CATEGORIES[category].label + roofWord(category)),
    el("code", { class: "record-id", title: buildingId }, buildingId),
  );
  const marks = el(
    "ul",
    { class: "marks" },
    typeof lod === "string" ? el("li", { class: "mark-plain" }, `LoD${lod}`) : null,
    modelled ? el("li", { class: valid === true ? "mark-good" : "mark-bad" }, valid === true ? "valid solid" : "not valid") : null,
    properties["is_curved"] === true ? el("li", { class: "mark-plain" }, "curved roof") : null,
    properties["touches_data_edge"] === true ? el("li", { class: "mark-warn" }, "at the edge of the data") : null,
  );
  const why =
    typeof reason === "string" && reason !== ""
      ? warningNotice(`${capital(reasonWords(reason))}${typeof detail === "string" && detail !== "" ? `: ${detail}` : "."}`)
      : null;
  const codes = Array.isArray(properties["validity_codes"]) ? properties["validity_codes"] : [];
  return [
    heading,
    marks,
    ...(why === null ? [] : [why]),
    el("div", { class: "record-links" }, dossierLink()),
    ...(codes.length > 0 ? [el("p", { class: "hint" }, `Codes of the method's own solid: ${codes.join(", ")}`)] : []),
    ...tables(properties, elevationUnitM),
    ...planes(properties["planes"]),
    ...(modelled ? [takeAway(properties["mesh_path"], path, method, buildingId)] : []),
  ];
}

/** Slope and aspect of each roof plane. */
function planes(value: unknown): HTMLElement[] {
  if (!Array.isArray(value) || value.length === 0) return [];
  const rows = (value as Record_[]).map((plane) =>
    el(
      "tr",
      {},
      el("td", {}, measure(plane["slope_deg"], 1, "°")),
      el("td", {}, measure(plane["aspect_deg"], 0, "°")),
      el("td", {}, measure(plane["area_m2"], 1, "m²")),
      el("td", {}, measure(plane["rmse_m"], 3, "m")),
    ),
  );
  const heads = ["Slope", "Aspect", "Area", "RMSE"].map((name) => el("th", { scope: "col" }, name));
  return [
    el(
      "section",
      {},
      el("h3", {}, "Roof planes"),
      el("table", {}, el("thead", {}, el("tr", {}, ...heads)), el("tbody", {}, ...rows)),
    ),
  ];
}

/** Downloads of one building; a job has meshes of one kind, or none. */
function takeAway(meshPath: unknown, path: string, method: string | null, buildingId: string): HTMLElement {
  const kind = typeof meshPath === "string" ? meshPath.slice(meshPath.lastIndexOf(".") + 1) : null;
  return el(
    "div",
    { class: "record-links" },
    kind === null ? null : downloadLink(kind.toUpperCase(), ofRun(`${path}?f=${kind}`, method), `${buildingId}.${kind}`),
    downloadLink("CityJSON", ofRun(`${path}?f=cityjson`, method), `${buildingId}.city.json`),
  );
}

function roofWord(category: string): string {
  return ["doubtful", "fallback", "failed"].includes(category) ? "" : " roof";
}
