import { ofRun } from "../api/requests";
import { getJson, type Problem } from "../api/requests";
import type { Feature } from "../api/types";
import { dossierLink, followDossier } from "../dossier/dossier_link";
import { downloadLink } from "../jobs/downloads";
import { el, swatch } from "../page/elements";
import { capital } from "../words/fields";
import { asProblem, problemNotice, warningNotice } from "../page/notices";
import { count, measure } from "../words/numbers";
import { reasonWords } from "../words/reasons";
import { CATEGORIES, categoryOf } from "../words/roof_types";
import { inMetres } from "../models/units";

type Record_ = Feature["properties"];

interface Row {
  label: string;
  column: string;
  show: (value: unknown) => string;
}

const metres = (digits: number) => (value: unknown) => measure(value, digits, "m");
const percent = (value: unknown): string => (typeof value === "number" ? measure(100 * value, 1, "%") : "–");
const whole = (value: unknown): string => (typeof value === "number" ? count(value) : "–");

/** The most important columns of the record; the file has all of them. */
function groups(elevationUnitM: number): [string, Row[]][] {
  const elevation = (value: unknown): string => measure(inMetres(value, elevationUnitM), 2, "m");
  return [
    [
      "Height",
      [
        { label: "Ridge above floor", column: "height_m", show: metres(2) },
        { label: "Ground", column: "ground_z", show: elevation },
        { label: "Eaves", column: "eave_z", show: elevation },
        { label: "Ridge", column: "ridge_z", show: elevation },
        { label: "Median of the roof", column: "h_50p", show: elevation },
      ],
    ],
    [
      "Size",
      [
        { label: "Footprint", column: "footprint_area_m2", show: (v) => measure(v, 1, "m²") },
        { label: "Roof, slanted", column: "roof_area_m2", show: (v) => measure(v, 1, "m²") },
        { label: "Volume", column: "volume_m3", show: (v) => measure(v, 0, "m³") },
        { label: "Roof planes", column: "n_planes", show: whole },
      ],
    ],
    [
      "Fit to the points",
      [
        { label: "Within 0.2 m of the roof", column: "share_within_0_2m", show: percent },
        { label: "RMSE", column: "rmse_m", show: metres(3) },
        { label: "95th percentile", column: "p95_m", show: metres(3) },
        { label: "Points covered", column: "coverage", show: percent },
        { label: "Points on facades and below", column: "share_below_roof", show: percent },
        { label: "Given footprint covered", column: "footprint_share", show: percent },
        { label: "Noise of the points", column: "noise_m", show: metres(3) },
        { label: "Ridge uncertainty (one sigma)", column: "ridge_z_sigma_m", show: metres(3) },
        { label: "Roof unexplained by points", column: "unexplained_m2", show: (v) => measure(v, 1, "m²") },
        { label: "Roof that was not seen", column: "extrapolated_share", show: percent },
        { label: "Largest hole in the points", column: "largest_hole_m", show: metres(1) },
        { label: "Confidence that it is a building", column: "detection_confidence", show: percent },
        { label: "Points", column: "n_points", show: whole },
        { label: "Density", column: "density_per_m2", show: (v) => measure(v, 1, "per m²") },
      ],
    ],
  ];
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
  const tables = groups(elevationUnitM).map(([title, rows]) =>
    el(
      "section",
      {},
      el("h3", {}, title),
      el(
        "dl",
        {},
        ...rows.flatMap(({ label, column, show }) => [el("dt", {}, label), el("dd", {}, show(properties[column]))]),
      ),
    ),
  );
  return [
    heading,
    marks,
    ...(why === null ? [] : [why]),
    el("div", { class: "record-links" }, dossierLink()),
    ...(codes.length > 0 ? [el("p", { class: "hint" }, `Codes of the method's own solid: ${codes.join(", ")}`)] : []),
    ...tables,
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
