import { currentKey, getJson, request, serviceUrl, type Link } from "./api";
import { el } from "./elements";
import { asProblem, problemNotice } from "./notices";
import { bytes } from "./numbers";

/** Outputs of the process, in the order in which people want them: label, what it is, name of the file. */
const OUTPUTS: Record<string, [string, string, string]> = {
  cityjson: ["CityJSON", "All models with semantics, CityJSONSeq 2.0", "buildings.city.jsonl"],
  meshes: ["OBJ", "One file a building, zipped", "meshes.zip"],
  buildings: ["GeoParquet", "Every building's record with its footprint", "buildings.parquet"],
  planes: ["GeoParquet, planes", "Every roof plane: slope, aspect, area, fit", "planes.parquet"],
  rejected: ["GeoParquet, rejected", "What was judged to be no building, and why", "rejected.parquet"],
  geojson: ["GeoJSON", "Footprints with the record, for any GIS", "buildings.geojson"],
  report: ["Report", "Settings, inputs, counts, timings, digest", "report.json"],
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
  // the browser reads the blob after the click: it must not be gone by then
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}

type Offered = Record<string, Link & { bytes?: number }>;

/** A menu of all outputs that the job has. */
export async function downloadMenu(jobPath: string, signal: AbortSignal): Promise<HTMLElement> {
  const offered = await getJson<Offered>(`${jobPath}/results`, { signal });
  const known = Object.keys(OUTPUTS).filter((name) => name in offered);
  const others = Object.keys(offered).filter((name) => !(name in OUTPUTS));
  const entries = [...known, ...others].map((name) => {
    const [label, words, filename] = OUTPUTS[name] ?? [name, offered[name]?.title ?? "", name];
    const size = offered[name]?.bytes;
    const note = el("span", { class: "hint" }, words);
    const weight = el("span", { class: "menu-size" }, typeof size === "number" ? bytes(size) : "");
    return el("li", {}, downloadLink(label, `${jobPath}/results/${name}`, filename, weight, note));
  });
  const menu = el(
    "details",
    { class: "menu" },
    el("summary", { class: "button primary" }, "Download"),
    el("ul", { class: "menu-list" }, ...entries),
  );
  menu.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    menu.open = false;
    menu.querySelector("summary")?.focus();
  });
  document.addEventListener("pointerdown", (event) => {
    if (!menu.contains(event.target as Node)) menu.open = false;
  }, { signal });
  return menu;
}
