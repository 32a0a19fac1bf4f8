/** The dossier of a building: its points over the model, the figures that decided, the forms that were tried. */

import { buildingOf, getJson, orNull, partOf, request, runReport, type Run } from "../api/requests";
import type { Decision, Feature } from "../api/types";
import { Batcher, type Batch } from "../models/batching";
import type { SceneFrame } from "../models/building_mesh";
import { SequenceReader, type Building } from "../models/cityjson";
import { CYCLE } from "../models/colouring";
import { COLUMNS, shown } from "../models/columns";
import { flatOutlines } from "../models/failed_footprints";
import { ringsOf } from "../models/plan";
import { elevationUnitM, inMetres, modelUnits } from "../models/units";
import { button, el, svg, type Properties } from "../page/elements";
import { report } from "../page/notices";
import { bareTable } from "../page/tables";
import { RESIDUALS } from "../points/points_colouring";
import { capital } from "../words/fields";
import { count, counted, measure } from "../words/numbers";
import { CATEGORIES, categoryOf } from "../words/roof_types";
import { histogramDrawing, planDrawing, planeColour, sectionDrawing, type Colouring, type Rings } from "./dossier_drawings";
import { histogram, modelOf, pointsIn, roofEdges, sectionOf, strip, stripWidth, type Points } from "./dossier_geometry";
import type { DossierScene } from "./dossier_scene";
import { checkRows, CHOSEN, formRows, trust, trustFigures, withinWords, type Row } from "./dossier_words";
import "./dossier.css";

interface Loaded {
  properties: Feature["properties"];
  outline: Rings;
  building: Building;
  /** Its model, or its outline if it has none, to be drawn in 3D. */
  batches: Batch[];
  frame: SceneFrame;
  crs: string;
  /** Null where the service recorded none. */
  decisions: Decision[] | null;
  /** Null where the run holds no points. */
  points: Points | null;
}

/** Show the dossier in front of the page; returns a function that closes it. `onClose` hears of the user's closing. */
export function openDossier(run: Run, buildingId: string, onClose: () => void): () => void {
  const calledOff = new AbortController();
  const body = el("div", { class: "dossier-body", "aria-live": "polite" }, el("p", { class: "loading" }, "Loading…"));
  const dialog = el("dialog", { class: "dossier", "aria-labelledby": "dossier-title" });
  dialog.append(
    el(
      "div",
      { class: "dossier-bar" },
      el("h1", { id: "dossier-title" }, "Dossier"),
      el("code", {}, buildingId),
      el("span", { class: "spacer" }),
      button("Print", () => window.print(), { class: "quiet" }),
      button("Close", () => dialog.close(), { class: "quiet", autofocus: true }),
    ),
    body,
  );
  let end: () => void = () => undefined;
  const close = (): void => {
    if (calledOff.signal.aborted) return;
    calledOff.abort();
    end();
    dialog.remove();
    document.body.classList.remove("has-dossier");
  };
  dialog.addEventListener("close", () => {
    close();
    onClose();
  });
  document.body.append(dialog);
  document.body.classList.add("has-dossier");
  dialog.showModal();
  load(run, buildingId, calledOff.signal).then(
    (loaded) => {
      if (!calledOff.signal.aborted) end = draw(body, loaded);
    },
    (error: unknown) => {
      if (!calledOff.signal.aborted) report(body, error);
    },
  );
  return close;
}

async function load(run: Run, id: string, signal: AbortSignal): Promise<Loaded> {
  const geojson = { signal, headers: { Accept: "application/geo+json" } };
  const offered = await getJson<Record<string, unknown>>(partOf(run, "results"), { signal });
  const [feature, document, report, decisions, points] = await Promise.all([
    getJson<Feature>(buildingOf(run, id, "?crs=native"), geojson),
    getJson<{ CityObjects: unknown; vertices: unknown }>(buildingOf(run, id, "?f=cityjson"), { signal }),
    "report" in offered ? runReport(run, signal) : null,
    orNull(getJson<{ decisions: Decision[] }>(buildingOf(run, id, "/decisions"), { signal })),
    "tileset" in offered ? pointsOf(buildingOf(run, id, "/points"), signal) : null,
  ]);
  const reader = new SequenceReader();
  reader.read(JSON.stringify({ ...document, CityObjects: {}, vertices: [] }));
  const { CityObjects, vertices } = document;
  const building = reader.read(JSON.stringify({ type: "CityJSONFeature", id, CityObjects, vertices }));
  if (building === null) throw new Error("the model of the building cannot be read");
  const rings = ringsOf(feature.geometry);
  const [x, y] = rings[0]?.[0] ?? [building.vertices[0] ?? 0, building.vertices[1] ?? 0];
  const units = modelUnits(report?.crs);
  const groundM = inMetres(feature.properties["ground_z"], elevationUnitM(report?.crs)) ?? 0;
  const frame: SceneFrame = { origin: [Math.floor(x), Math.floor(y), groundM / units.verticalUnitM], ...units };
  const outline = rings.map((ring) =>
    ring.map(([e, n]) => [(e - frame.origin[0]) * frame.horizontalUnitM, (n - frame.origin[1]) * frame.horizontalUnitM] as const),
  );
  return {
    properties: feature.properties,
    outline,
    building,
    batches: batchesOf(feature, building, frame),
    frame,
    crs: report?.crs?.name ?? "CRS unknown",
    decisions: decisions?.decisions ?? null,
    points: points === null ? null : pointsIn(points, frame),
  };
}

function batchesOf(feature: Feature, building: Building, frame: SceneFrame): Batch[] {
  if (building.faces.length === 0) return flatOutlines([feature], "failed", frame, () => 0).batches;
  const batcher = new Batcher(frame);
  batcher.add(building);
  return batcher.take().batches;
}

/** The points of a building; null for one whose process ended before they were assigned to it. */
async function pointsOf(path: string, signal: AbortSignal): Promise<ArrayBuffer | null> {
  return orNull(request(path, { signal, headers: { Accept: "model/gltf-binary" } }).then((response) => response.arrayBuffer()));
}

/** Fill the dialog; returns a function that frees what the drawings hold. */
function draw(body: HTMLElement, loaded: Loaded): () => void {
  const { properties, points, building, frame, decisions, outline } = loaded;
  const model = modelOf(building, frame);
  const edges = roofEdges(model);
  const section = sectionOf(model, edges);
  const halfWidthM = points === null || section === null ? 0.5 : stripWidth(points, section);
  const plan = el("div", { class: "dossier-drawing" });
  const profile = el("div", { class: "dossier-drawing" });
  const key = el("ul", { class: "dossier-key" });
  let scene: DossierScene | null = null;
  let over = false;
  let colouring: Colouring = "residual";
  const paint = (chosen: Colouring): void => {
    colouring = chosen;
    plan.replaceChildren(planDrawing(outline, edges, section, points, colouring));
    if (section !== null) profile.replaceChildren(sectionDrawing(model, section, points, halfWidthM, colouring));
    key.replaceChildren(...(points === null ? [] : colourKey(points, colouring)));
    scene?.colour(colouring);
  };
  const canvas = el("canvas", {
    class: "dossier-canvas",
    tabindex: 0,
    role: "img",
    "aria-label": "The model and its points in 3D. Arrow keys turn, plus and minus zoom.",
  });
  const stage = el("div", { class: "dossier-drawing dossier-space stage3d" }, canvas);
  const space = loaded.batches.length > 0 ? figure("In 3D", "Drag to turn, the wheel zooms.", stage) : null;
  const inStrip = points === null || section === null ? 0 : strip(points, section, halfWidthM).length;
  const stripWords = points === null ? "" : ` ${counted(inStrip, "point")} within ${measure(halfWidthM, 1, "m")} of the line.`;
  body.replaceChildren(
    facts(properties, loaded.crs),
    verdict(properties, decisions ?? []),
    points === null
      ? el("p", { class: "hint dossier-nopoints" }, "This run holds no points, so only the model is drawn. Runs that write points show them here.")
      : el("div", { class: "dossier-colours" }, colourChoice(paint), key),
    el(
      "div",
      { class: "dossier-figures" },
      figure("Plan", section === null ? "North is up." : "North is up; A to B is the line of the section.", plan),
      section === null ? null : figure("Section", `${capital(section.through)}, not exaggerated.${stripWords}`, profile),
      space,
      points === null ? null : figure("Residuals", residualWords(points, properties), el("div", { class: "dossier-drawing" }, histogramDrawing(points.residuals))),
    ),
    table("The figures that decided", [...checkRows(decisions ?? []), ...trustFigures(properties).map(({ row }) => row)]),
    table(
      "The forms that were tried",
      formRows(decisions ?? [], properties),
      decisions === null ? "This job was made by a version that recorded none." : "None was tried.",
    ),
  );
  paint(colouring);
  if (space !== null) {
    import("./dossier_scene")
      .then((loaded3d) => {
        if (!over) scene = new loaded3d.DossierScene(canvas, loaded.batches, points, colouring);
      })
      .catch(() => stage.replaceWith(el("p", { class: "hint" }, "This browser cannot draw in 3D, or the view could not be loaded.")));
  }
  return () => {
    over = true;
    scene?.dispose();
  };
}

function colourChoice(onChoice: (colouring: Colouring) => void): HTMLElement {
  const option = (value: Colouring, words: string): HTMLElement =>
    el(
      "label",
      {},
      el("input", { type: "radio", name: "dossier-colour", value, checked: value === "residual", onchange: () => onChoice(value) }),
      words,
    );
  return el("fieldset", {}, el("legend", {}, "Points coloured by"), option("residual", "residual"), option("plane", "roof plane"));
}

/** The colours in use, each with its meaning. */
function colourKey(points: Points, colouring: Colouring): HTMLElement[] {
  const mark = (colour: string): Element =>
    svg("svg", { viewBox: "0 0 10 10", class: "dossier-dot", "aria-hidden": "true" }, svg("circle", { cx: 5, cy: 5, r: 4.5, fill: colour }));
  const entry = (colour: string, words: string): HTMLElement => el("li", {}, mark(colour), words);
  if (colouring === "residual") {
    const { uncovered } = histogram(points.residuals);
    const shown = uncovered > 0 ? RESIDUALS : RESIDUALS.slice(0, -1);
    return shown.map(({ colour, label }) => entry(colour, label));
  }
  const used = [...new Set(points.planes)].sort((a, b) => a - b);
  const shown = used.filter((plane) => plane >= 0).slice(0, CYCLE.length);
  return [
    ...shown.map((plane) => entry(planeColour(plane), `plane ${plane}`)),
    ...(used.length > shown.length + 1 ? [el("li", {}, "further planes repeat the colours")] : []),
    ...(used.includes(-1) ? [entry(planeColour(-1), "no plane")] : []),
  ];
}

function residualWords(points: Points, properties: Feature["properties"]): string {
  const { total, uncovered, below, above, reachM } = histogram(points.residuals);
  const within = points.residuals.filter((residual) => Math.abs(residual) <= 0.2).length;
  const share = points.residuals.length === 0 ? 0 : within / points.residuals.length;
  const beyond = below + above > 0 ? ` ${count(below + above)} differ by more than ${measure(reachM, 1, "m")} and are not drawn.` : "";
  const bare = uncovered > 0 ? ` ${count(uncovered)} have no roof above or below them.` : "";
  return `${counted(total, "point")} over the roof; ${withinWords(share, properties)}.${beyond}${bare}`;
}

function figure(title: string, words: string, content: HTMLElement): HTMLElement {
  return el("figure", {}, el("h2", {}, title), content, el("figcaption", {}, words));
}

const FACTS = ["height_m", "footprint_area_m2", "volume_m3", "n_planes", "n_points", "density_per_m2"] as const;

/** The most important facts in one line each. */
function facts(properties: Feature["properties"], crs: string): HTMLElement {
  const category = categoryOf(properties["status"], properties["roof_type"]);
  const lod = typeof properties["lod"] === "string" ? ` · LoD${properties["lod"]}` : "";
  const rows: [string, string][] = [
    ["Form", `${CATEGORIES[category].label}${lod}`],
    ["Method", String(properties["method"] ?? "–")],
    ...FACTS.map((name): [string, string] => [COLUMNS[name].label, shown(name, properties[name])]),
    ["CRS", crs],
  ];
  return el("dl", { class: "dossier-facts" }, ...rows.map(([name, value]) => el("div", {}, el("dt", {}, name), el("dd", {}, value))));
}

function verdict(properties: Feature["properties"], decisions: Decision[]): HTMLElement {
  const { good, bad } = trust(properties, decisions);
  const list = (name: string, title: string, sentences: string[]): HTMLElement | null =>
    sentences.length === 0 ? null : el("section", { class: name }, el("h2", {}, title), el("ul", {}, ...sentences.map((words) => el("li", {}, words))));
  return el("div", { class: "dossier-verdict" }, list("trusted", "You can rely on", good), list("doubted", "Look twice at", bad));
}

/** Rows of a table, without the columns that say nothing. */
function table(caption: string, rows: readonly Row[], nothing = ""): HTMLElement {
  const heads = Object.keys(rows[0] ?? {}).filter((head) => rows.some((row) => !["", "–"].includes(row[head])));
  const columns = heads.map((head) => ({ head, cell: (row: Row) => row[head] }));
  const region = { class: "dossier-scroll", tabindex: 0, role: "region", "aria-label": caption };
  const isChosen = (row: Row): Properties => ({ class: CHOSEN.includes(row["Outcome"]) ? "dossier-chosen" : null });
  const content = rows.length > 0 ? el("div", region, bareTable({}, columns, rows, isChosen)) : el("p", { class: "hint" }, nothing);
  return el("section", { class: "dossier-table" }, el("h2", {}, caption), content);
}
