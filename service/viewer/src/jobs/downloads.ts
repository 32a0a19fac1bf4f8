import { currentKey, getJson, ofRun, request, serviceUrl } from "../api/requests";
import type { Link } from "../api/types";
import { dropDown } from "../page/action_menu";
import { el } from "../page/elements";
import { asProblem, problemNotice } from "../page/notices";
import { bytes, counted } from "../words/numbers";

/** Outputs of the process, the most wanted ones first: label, description, file name. */
const OUTPUTS: Record<string, [string, string, string]> = {
  cityjson: ["CityJSON", "All models with semantics, CityJSONSeq 2.0", "buildings.city.jsonl"],
  meshes: ["Meshes", "OBJ or GLB, as requested, zipped", "meshes.zip"],
  buildings: ["GeoParquet", "Every building's record with its footprint and solids", "buildings.parquet"],
  planes: ["GeoParquet, planes", "Every roof plane: slope, aspect, area, fit", "planes.parquet"],
  rejected: ["GeoParquet, rejected", "Objects that are not buildings, with reasons", "rejected.parquet"],
  geojson: ["GeoJSON", "Footprints with the record, for any GIS", "buildings.geojson"],
  report: ["Report", "Settings, inputs, counts, timings, digest", "report.json"],
  "3dtiles": ["3D Tiles", "Tileset for CesiumJS, which opens the address of this link", "tileset.json"],
  "3dtiles-zip": ["3D Tiles, zip", "The tileset with its files, for another server", "3dtiles.zip"],
  geopackage: ["GeoPackage", "All tables with styles, for QGIS", "models.gpkg"],
  pmtiles: ["PMTiles", "Footprints as vector tiles, for maps on the web", "models.pmtiles"],
  "cityjson-zip": ["CityJSON, files", "One file per tile, zipped", "cityjson.zip"],
  stac: ["STAC", "A catalogue of the tiles and their files", "collection.json"],
  solar: ["Solar energy, GeoParquet", "Sky view and irradiation of every roof plane", "solar.parquet"],
  "party-walls": ["Party walls, GeoParquet", "Walls that neighbouring buildings share", "party_walls.parquet"],
  "wall-areas": ["Wall areas, GeoParquet", "Shared and exposed walls of every building", "wall_areas.parquet"],
};

/** Outputs of a classification. */
const CLASSIFIED: typeof OUTPUTS = {
  points: ["Points, LAZ", "Every tile with its classes, zipped", "points.zip"],
  terrain: ["Terrain, GeoTIFF", "Elevation of the ground", "terrain.tif"],
  surface: ["Surface, GeoTIFF", "Elevation of the highest point of each cell", "surface.tif"],
  height: ["Height, GeoTIFF", "Height of the surface above the ground", "height.tif"],
  classes: ["Counts, JSON", "Points by class, warnings, timings", "classes.json"],
};

/** Outputs of a comparison as a whole; its page has a separate link. */
const COMPARED: typeof OUTPUTS = {
  table: ["All methods, GeoParquet", "One row per building and method", "compared.parquet"],
  summary: ["All methods, summary", "Presets, hashes, counts, seconds", "compare.json"],
  archive: ["All methods, zip", "The page, the table, every run", "comparison.zip"],
};

/**
 * A link that saves a file. With a key the file is fetched with it first, since a link cannot carry a header and a key
 * never goes into an address.
 */
export function downloadLink(label: string, path: string, filename: string, ...more: HTMLElement[]): HTMLAnchorElement {
  const link = el("a", { href: serviceUrl(path), download: filename }, label, ...more);
  link.addEventListener("click", (event) => {
    if (currentKey() === null || link.href.startsWith("blob:")) return;
    event.preventDefault();
    link.setAttribute("aria-busy", "true");
    save(path, filename)
      .catch((error: unknown) => void link.after(problemNotice(asProblem(error))))
      .finally(() => link.removeAttribute("aria-busy"));
  });
  return link;
}

async function save(path: string, filename: string): Promise<void> {
  const response = await request(path, { headers: { Accept: "*/*" } });
  const address = URL.createObjectURL(await response.blob());
  const link = el("a", { href: address, download: filename });
  link.click();
  // the browser reads the blob after the click, so it must still exist then
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}

/** A link to the page of a comparison; with a key the page can only be saved and then opened. */
export function pageLink(jobPath: string, name: string): HTMLAnchorElement {
  const path = `${jobPath}/results/page`;
  if (currentKey() !== null) {
    const saved = downloadLink("Save the comparison", path, "comparison.html");
    saved.setAttribute("aria-label", `Save: ${name}`);
    return saved;
  }
  return el("a", { href: serviceUrl(path), target: "_blank", rel: "noopener", "aria-label": name }, "Comparison");
}

type Offered = Record<string, Link & { bytes?: number }>;

/** Milliseconds between two questions whether a selection of buildings is made. */
const ASK_AGAIN_MS = 2000;

/**
 * A menu of all outputs of the job; for a comparison those of one run, then those of all. Where some buildings are not
 * ok, it offers the outputs of the others alone.
 */
export async function downloadMenu(
  jobPath: string,
  method: string | null,
  statuses: Record<string, number>,
  signal: AbortSignal,
): Promise<HTMLElement> {
  const list = await downloadList(jobPath, method, signal);
  const { ok = 0, ...others } = statuses;
  if (ok > 0 && Object.values(others).some((count) => count > 0)) list.prepend(onlyOk(list, ok, jobPath, method, signal));
  return dropDown(el("summary", { class: "button primary" }, "Download"), list);
}

/** A switch between the outputs of all buildings and those of the ones that are ok. */
function onlyOk(list: HTMLElement, count: number, jobPath: string, method: string | null, signal: AbortSignal): HTMLElement {
  const all = [...list.children];
  const box = el("input", { type: "checkbox" });
  const entry = el("li", { class: "menu-choice" }, el("label", {}, box, ` Only the ${counted(count, "model")} that ${count === 1 ? "is" : "are"} ok`));
  // the switch stays where it is, so it keeps the focus
  const show = (entries: Element[]): void => {
    for (const other of [...list.children]) if (other !== entry) other.remove();
    list.append(...entries);
  };
  box.addEventListener("change", () => {
    if (!box.checked) return show(all);
    show([el("li", { class: "hint menu-wait", role: "status" }, "These files are being made…")]);
    selected(`${jobPath}/results?status=ok`, method, signal)
      .then((offered) => listed(offered, OUTPUTS, jobPath, method, "ok"))
      .catch((error: unknown) => [el("li", {}, problemNotice(asProblem(error)))])
      .then((entries) => {
        if (box.checked) show(entries);
      });
  });
  return entry;
}

/** The outputs of a selection, once they are made. */
async function selected(path: string, method: string | null, signal: AbortSignal): Promise<Offered> {
  for (;;) {
    try {
      return await getJson<Offered>(ofRun(path, method), { signal });
    } catch (error) {
      if (asProblem(error).kind !== "selection-busy") throw error;
      await new Promise((resolve) => setTimeout(resolve, ASK_AGAIN_MS));
    }
  }
}

/** A list of the same outputs. */
export async function downloadList(jobPath: string, method: string | null, signal: AbortSignal): Promise<HTMLElement> {
  const offer = (of: string | null): Promise<Offered> => getJson<Offered>(ofRun(`${jobPath}/results`, of), { signal });
  const entries = listed(await offer(method), { ...OUTPUTS, ...CLASSIFIED }, jobPath, method);
  if (method !== null) {
    const { page: _page, ...compared } = await offer(null);
    entries.push(...listed(compared, COMPARED, jobPath, null));
  }
  return el("ul", { class: "outputs" }, ...entries);
}

/** Entries of the menu: known outputs in their order, then any others. */
function listed(offered: Offered, known: typeof OUTPUTS, jobPath: string, method: string | null, status = ""): HTMLElement[] {
  const names = [...Object.keys(known), ...Object.keys(offered).filter((name) => !(name in known))];
  return names
    .filter((name) => name in offered)
    .map((name) => {
      const [label, words, filename] = known[name] ?? [name, offered[name]?.title ?? "", name];
      const size = offered[name]?.bytes;
      const note = el("span", { class: "hint" }, words);
      const weight = el("span", { class: "menu-size" }, typeof size === "number" ? bytes(size) : "");
      const saved = [method, status, filename].filter(Boolean).join("-");
      const path = `${jobPath}/results/${name}${status && `?status=${status}`}`;
      return el("li", {}, downloadLink(label, ofRun(path, method), saved, weight, note));
    });
}
