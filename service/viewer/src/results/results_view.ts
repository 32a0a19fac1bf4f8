import { addressOf, placeOf, queryOf, type Place } from "../page/address";
import { ofRun, runReport, pathOfJob } from "../api/requests";
import { getJson } from "../api/requests";
import type { Feature, RunReport } from "../api/types";
import type { StatusInfo } from "../api/types";
import type { Batch, Listed } from "../models/batching";
import type { SceneFrame } from "../models/building_mesh";
import { BuildingList, tallyWords } from "./building_list";
import { downloadMenu, pageLink } from "../jobs/downloads";
import { el } from "../page/elements";
import { flatOutlines } from "../models/failed_footprints";
import { FIGURE_NAMES } from "../models/figures";
import { FilterPanel } from "./filter_panel";
import type { Hooks } from "../page/view";
import { jobMenu } from "../jobs/job_actions";
import { capital } from "../words/fields";
import { buildingWords, titleOf } from "../jobs/job_words";
import { Legend } from "./legend";
import { LevelChoice } from "./level_choice";
import { loadModels } from "../models/model_loading";
import type { FromLoading } from "../models/loading_messages";
import { announce, asProblem, problemNotice, warningNotice } from "../page/notices";
import { count, counted, duration, measure } from "../words/numbers";
import { outlineColour, type Colouring } from "../models/colouring";
import type { OutlineMap } from "../map/outline_map";
import type { Outlines } from "../models/outlines";
import { showRecord } from "./record";
import { rejectedRecord } from "./rejected_record";
import { CATEGORIES, CATEGORY_NAMES, type Category } from "../words/roof_types";
import { ModelScene } from "../scene/scene";
import { USUAL, isFiltered, queryWith, selected, tallies, wantedOf, type Wanted } from "../models/selection";
import { elevationUnitM, modelUnits } from "../models/units";
import { ViewTools } from "../tools/view_tools";

/** Show the results of a job: models, list, records and downloads. Returns a function that ends the view. */
export function showResults(place: HTMLElement, job: StatusInfo, named: Place, hooks: Hooks): () => void {
  const view = new ResultsView(place, job, named.method, hooks);
  view.start().catch((error: unknown) => view.fail(error));
  return () => view.leave();
}

class ResultsView {
  private readonly calledOff = new AbortController();
  private readonly jobPath: string;
  /** Labels of the runs of a comparison; empty for other jobs. */
  private readonly methods: string[];
  /** The one whose models are shown. */
  private readonly method: string | null;
  private readonly canvas = el("canvas", {
    tabindex: 0,
    role: "img",
    "aria-label":
      "The models in 3D. Arrow keys turn, plus and minus zoom, f shows all, t looks from above. The list beside it leads to every record.",
  });
  private readonly note = el("div", { class: "stage-note" });
  private readonly facts = el("div", { class: "result-facts" }, "\u00a0");
  private readonly downloads = el("div", { class: "result-actions" });
  private readonly panel = el("aside", { class: "panel", "aria-label": "Buildings" });
  private readonly list: BuildingList;
  private readonly filters = new FilterPanel((wanted) => this.change(wanted));
  private readonly listView: HTMLElement;
  private readonly legend: Legend;
  private readonly levels = new LevelChoice((lod) => void this.showLevel(lod));
  private readonly viewTools = new ViewTools();
  private readonly counts = new Map<Category, number>();
  /** The candidates, and once they are wanted the objects that were left out. */
  private readonly listed: Listed[] = [];
  private readonly byId = new Map<string, Listed>();
  private readonly rejected = new Map<string, Listed>();
  private loadingRejected: Promise<void> | null = null;
  private readonly outlines: Outlines[] = [];
  private wanted: Wanted = USUAL;
  private shown: Listed[] = [];
  private scene: ModelScene | null = null;
  private map: OutlineMap | null = null;
  private colouring: Colouring = "type";
  private readonly stage: HTMLElement;
  private readonly top = el("button", { type: "button", title: "From above, north up (t)", onclick: () => this.scene?.top() }, "Top");
  private readonly modes = {
    "3d": el("button", { type: "button", onclick: () => this.change({ ...this.wanted, map: false }) }, "3D"),
    map: el("button", { type: "button", onclick: () => this.change({ ...this.wanted, map: true }) }, "Map"),
  };
  private stopRecord: () => void = () => undefined;
  private otherLevel = new AbortController();
  private report: RunReport = {};
  private selected: string | null = null;
  private origin: readonly [number, number, number] = [0, 0, 0];
  private fromScene = false;
  private isLoaded = false;
  private hasOrigin = false;

  constructor(
    place: HTMLElement,
    private readonly job: StatusInfo,
    private readonly named: string | null,
    private readonly hooks: Hooks,
  ) {
    this.methods = Object.keys(job.summary?.runs ?? {});
    this.method = named ?? this.methods[0] ?? null;
    this.jobPath = pathOfJob(job.jobID);
    this.list = new BuildingList((id) => this.address(id));
    this.legend = new Legend(
      (category, visible) => {
        const hidden = new Set(this.wanted.hidden);
        if (visible) hidden.delete(category);
        else hidden.add(category);
        this.change({ ...this.wanted, hidden });
      },
      (colouring) => {
        this.colouring = colouring;
        this.scene?.colourBy(colouring);
        this.colourMap();
      },
    );
    const mode = el("div", { class: "tool-group", role: "group", "aria-label": "3D or map" }, ...Object.values(this.modes));
    const view = el(
      "div",
      { class: "tool-group", role: "group", "aria-label": "View" },
      el("button", { type: "button", title: "Show all (f)", onclick: () => (this.map ?? this.scene)?.fit() }, "Fit"),
      this.top,
    );
    this.listView = el("div", { class: "list" }, this.filters.element, this.list.element);
    this.panel.replaceChildren(this.listView);
    this.stage = el("div", { class: "stage3d" }, this.canvas, this.viewTools.cards, this.viewTools.bar(this.levels.element, mode, view), this.note);
    place.replaceChildren(
      el(
        "div",
        { class: "result" },
        el(
          "div",
          { class: "result-head" },
          el("div", { class: "result-title" }, el("h1", {}, titleOf(job)), this.facts),
          this.downloads,
        ),
        this.legend.element,
        this.stage,
        this.panel,
      ),
    );
  }

  async start(): Promise<void> {
    window.addEventListener("hashchange", () => this.followAddress(), { signal: this.calledOff.signal });
    const { summary } = this.job;
    const statuses = (this.method === null ? summary : summary?.runs?.[this.method])?.statuses ?? {};
    const [report, menu] = await Promise.all([
      runReport(this.jobPath, this.method, this.calledOff.signal),
      downloadMenu(this.jobPath, this.method, statuses, this.calledOff.signal),
    ]);
    if (this.calledOff.signal.aborted) return;
    this.report = report;
    this.counts.set("rejected", report.counts?.["rejected"] ?? 0);
    this.wanted = wantedOf(new URLSearchParams(queryOf(location.hash)));
    this.apply();
    this.downloads.replaceChildren(...this.comparison(), menu, jobMenu(this.job, this.hooks));
    this.showFacts();
    try {
      this.scene = new ModelScene(this.canvas, (id) => this.open(id));
      this.viewTools.attach(this.scene, this.canvas);
    } catch {
      this.note.replaceChildren(
        warningNotice("This browser cannot draw in 3D (WebGL is missing or switched off). The map, the list, the records and the downloads still work."),
      );
      this.wanted = { ...this.wanted, map: true };
    }
    this.note.append(el("p", { class: "loading" }, "Loading the models…"));
    const levels = await this.load(
      null,
      (message) => {
        if (message.kind === "frame") [this.origin, this.hasOrigin] = [message.origin, true];
        if (message.kind !== "buildings") return;
        this.scene?.add(message.batches);
        this.take(message.listed, message.outlines);
      },
      this.calledOff.signal,
    );
    await this.finished(levels);
  }

  /** Say what went wrong; `again` tries it once more. */
  fail(error: unknown, again?: () => void): void {
    if (this.calledOff.signal.aborted) return;
    const problem = asProblem(error);
    const retry = (): void => {
      this.note.replaceChildren();
      again?.();
    };
    this.note.replaceChildren(problemNotice(problem, again && retry));
    this.hooks.onProblem(problem);
  }

  leave(): void {
    this.calledOff.abort();
    this.otherLevel.abort();
    this.stopRecord();
    this.viewTools.leave();
    this.scene?.dispose();
    this.map?.dispose();
  }

  // --- loading

  /** Read the models at a level of detail, null for the finest of each; returns the available levels. */
  private load(lod: string | null, onMessage: (message: FromLoading) => void, signal: AbortSignal): Promise<string[]> {
    const { crs } = this.report;
    const reading = { ...modelUnits(crs), lod };
    return loadModels(ofRun(`${this.jobPath}/results/cityjson`, this.method), reading, onMessage, signal);
  }

  /** Show the models at another level of detail from the same place; the old ones stay until the new ones are read. */
  private async showLevel(lod: string): Promise<void> {
    this.otherLevel.abort();
    const { signal } = (this.otherLevel = new AbortController());
    const batches: Batch[] = [];
    this.note.replaceChildren(el("p", { class: "loading" }, `Loading LoD${lod}…`));
    try {
      await this.load(lod, (message) => void (message.kind === "buildings" && batches.push(...message.batches)), signal);
    } catch (error) {
      if (!signal.aborted) this.fail(error);
      return;
    }
    this.note.replaceChildren();
    this.scene?.replace(batches);
    this.scene?.select(this.selected, false);
    this.levels.mark(lod);
    announce(`LoD${lod} is shown.`);
  }

  private take(listed: Listed[], outlines: Outlines): void {
    for (const object of listed) {
      this.listed.push(object);
      this.byId.set(object.id, object);
      if (object.category !== "rejected") this.counts.set(object.category, (this.counts.get(object.category) ?? 0) + 1);
    }
    this.outlines.push(outlines);
    this.map?.add(outlines);
    this.apply();
  }

  private async finished(levels: string[]): Promise<void> {
    this.scene?.finish();
    this.note.querySelector(".loading")?.remove();
    this.showFacts();
    this.isLoaded = true;
    if (this.listed.length === 0) {
      this.note.replaceChildren(this.nothing());
      this.note.closest(".result")?.classList.add("result-empty");
      announce("No building was found.");
      this.apply();
      await this.chooseAddressed();
      return;
    }
    announce(`${counted(this.listed.length, "building")} loaded.`);
    const offered = this.viewTools.offerPoints(this.jobPath, this.method, this.frame());
    if (this.counts.has("failed")) {
      await offered; // outlines lie on the terrain
      await this.drawFailed().catch((error: unknown) => this.fail(error));
    }
    if (this.calledOff.signal.aborted) return;
    this.apply();
    await this.chooseAddressed();
    if (this.scene !== null) this.levels.offer(levels);
    await offered;
    this.canvas.dataset["ready"] = "true";
  }

  /** The scene in the coordinates of the job. */
  private frame(): SceneFrame {
    const { crs } = this.report;
    return { origin: this.origin, ...modelUnits(crs) };
  }

  /** Draw the footprints of buildings without a model: only the records have their place. */
  private async drawFailed(): Promise<void> {
    const failed = ofRun(`${this.jobPath}/buildings?status=failed&limit=10000&crs=native`, this.method);
    const page = await getJson<{ features: Feature[] }>(failed, {
      signal: this.calledOff.signal,
      headers: { Accept: "application/geo+json" },
    });
    this.placeBy(page.features);
    this.takeOutlines(page.features, "failed");
  }

  /** Draw objects without a model. */
  private takeOutlines(features: readonly Feature[], status: "failed" | "rejected"): void {
    const { scene } = this;
    const { batches, outlines } = flatOutlines(features, status, this.frame(), (x, y) => scene?.groundAt(x, y) ?? 0);
    scene?.add(batches);
    this.take(status === "rejected" ? [...this.rejected.values()] : [], outlines);
  }

  // --- filters, order and the map

  /** Show something else, and name it in the address. */
  private change(wanted: Wanted): void {
    this.wanted = wanted;
    history.replaceState(history.state, "", this.address(this.selected));
    this.apply();
    announce(`${tallyWords(this.shown.length, this.listed.length)} objects are listed.`);
  }

  /** Bring the list, the legend, the 3D view and the map to what is wanted. */
  private apply(): void {
    const { wanted } = this;
    const counts = tallies(this.listed, wanted);
    if (this.loadingRejected === null) counts.categories.set("rejected", this.counts.get("rejected") ?? 0);
    for (const category of CATEGORY_NAMES) {
      // a category that the other filters empty stays in the filters
      if ((this.counts.get(category) ?? 0) > 0 && !counts.categories.has(category)) counts.categories.set(category, 0);
    }
    this.shown = selected(this.listed, wanted);
    const all = CATEGORY_NAMES.reduce((n, name) => n + (wanted.hidden.has(name) ? 0 : (this.counts.get(name) ?? 0)), 0);
    const figure = FIGURE_NAMES.find((name) => name === wanted.sort) ?? null;
    this.list.set(this.shown, figure, this.listed.length === 0 ? "" : "No object fits these filters.");
    this.filters.set(wanted, { shown: this.shown.length, all, ...counts });
    this.legend.set(this.counts, this.shown);
    this.legend.check(wanted.hidden);
    const only = isFiltered(wanted) ? new Set(this.shown.map(({ id }) => id)) : null;
    this.scene?.showOnly(only);
    this.map?.showOnly(only);
    if (!this.isLoaded) return;
    if (!wanted.hidden.has("rejected")) void this.loadRejected().catch((error: unknown) => this.fail(error, this.retry));
    this.showMap(wanted.map).catch((error: unknown) => this.fail(error));
  }

  /** Take the scene's origin from outlines if there is no model: far from it the figures would be too coarse. */
  private placeBy(features: readonly Feature[]): void {
    const first = cornerOf(features);
    if (!this.hasOrigin && first !== null) [this.origin, this.hasOrigin] = [first, true];
  }

  /** Load the objects that were left out, unless they are there already. */
  private loadRejected(): Promise<void> {
    const load = async (): Promise<void> => {
      if (this.counts.get("rejected") === 0) return;
      const { listedRejected, rejectedObjects } = await import("../models/rejected_objects");
      const features = await rejectedObjects(this.jobPath, this.method, this.calledOff.signal);
      for (const feature of features) {
        const object = listedRejected(feature);
        this.rejected.set(object.id, object);
      }
      this.stage.closest(".result-empty")?.classList.remove("result-empty");
      this.note.querySelector(".card")?.remove();
      this.placeBy(features);
      this.takeOutlines(features, "rejected");
    };
    this.loadingRejected ??= load().catch((error: unknown) => {
      this.loadingRejected = null; // it can be tried again
      throw error;
    });
    return this.loadingRejected;
  }

  /** Show the map in place of the 3D view, or the 3D view. */
  private async showMap(wanted: boolean): Promise<void> {
    this.modes["3d"].setAttribute("aria-pressed", String(!wanted));
    this.modes.map.setAttribute("aria-pressed", String(wanted));
    this.top.hidden = wanted;
    this.canvas.hidden = wanted;
    this.levels.element.classList.toggle("levels-away", wanted);
    this.viewTools.setAway(wanted);
    if (!wanted) {
      this.map?.dispose();
      this.map = null;
      return;
    }
    if (this.map !== null) return;
    const { OutlineMap } = await import("../map/outline_map");
    if (this.calledOff.signal.aborted || !this.wanted.map || this.map !== null) return;
    const map = new OutlineMap((id) => this.open(id));
    this.map = map;
    this.colourMap();
    this.stage.prepend(map.element);
    for (const outlines of this.outlines) map.add(outlines);
    if (isFiltered(this.wanted)) map.showOnly(new Set(this.shown.map(({ id }) => id)));
    map.select(this.selected, this.selected !== null);
    await this.layBackground(map);
  }

  /** Give the map the colours of the legend, also for the objects that are still to come. */
  private colourMap(): void {
    this.map?.colourBy(({ id, category }) => {
      const object = this.byId.get(id);
      return object === undefined ? CATEGORIES[category].colour : outlineColour(this.colouring, object);
    });
  }

  /** Lay the operator's tiles beneath the map, if there are some and the results lie on Earth. */
  private async layBackground(map: OutlineMap): Promise<void> {
    const { crs } = this.report;
    if (document.querySelector('meta[name="map-tiles"]') === null || (crs?.to_wgs84 ?? null) === null) return;
    const { Background, locate, tileSource } = await import("../map/background");
    const source = tileSource();
    if (source === null) return;
    const [unit, [east, north]] = [crs?.horizontal_unit_m ?? 1, this.origin];
    const inPlane = ([x, y]: [number, number]): [number, number] => [(x - east) * unit, (y - north) * unit];
    const place = await locate(this.jobPath, this.method, inPlane, this.calledOff.signal);
    if (place === null || this.map !== map) return;
    const within = place.errorM < 0.5 ? "" : ` · placed to within ${measure(place.errorM, 1, "m")}`;
    map.lay(new Background(source, place, map.request), `${source.credit}${within}`);
  }

  private showFacts(): void {
    const tally = this.report.counts ?? {};
    const rejected = tally["rejected"];
    const points = tally["points"];
    const seconds = this.report.timings_s?.["total"];
    const warnings = this.report.warnings ?? [];
    const crsName = this.report.crs?.name ?? "unknown";
    const of = (category: Category): number => this.counts.get(category) ?? 0;
    const [doubtful, fallback, failed] = [of("doubtful"), of("fallback"), of("failed")];
    const ok = this.listed.length - this.rejected.size - doubtful - fallback - failed;
    const facts = [
      this.listed.length > this.rejected.size ? buildingWords({ ok, doubtful, fallback, failed }) : null,
      rejected === undefined ? null : `${count(rejected)} other objects left out`,
      points === undefined ? null : `${count(points)} points`,
      seconds === undefined ? null : duration(seconds),
      crsName === "unknown" ? "CRS unknown" : crsName,
    ]
      .filter((fact) => fact !== null)
      .join(" · ");
    const notice = el(
      "details",
      { class: "menu menu-warnings" },
      el("summary", {}, counted(warnings.length, "warning")),
      el("div", { class: "menu-list" }, warningNotice(...warnings)),
    );
    const headline = this.report.headline ?? "";
    this.facts.replaceChildren(headline === "" ? "" : warningNotice(capital(headline)), facts, warnings.length === 0 ? "" : " · ", warnings.length === 0 ? "" : notice);
  }

  /** Say what to try if the result is empty. */
  private nothing(): HTMLElement {
    const rejected = this.report.counts?.["rejected"] ?? 0;
    return el(
      "div",
      { class: "card" },
      el("h2", {}, "No building was found"),
      el(
        "p",
        {},
        rejected > 0
          ? `${counted(rejected, "object")} ${rejected === 1 ? "was" : "were"} looked at and left out: too small, too low, too narrow, or vegetation. Each is in the list under “Without a model”, and in the download “rejected”, with its reason and the measured figure.`
          : capital(this.report.headline || "Nothing rises above the ground."),
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

  // --- the methods of a comparison

  /** The choice of the method whose models are shown, and the link to the page with all methods. */
  private comparison(): HTMLElement[] {
    if (this.methods.length === 0) return [];
    const choice = el(
      "select",
      { "aria-label": "Models of the method" },
      ...this.methods.map((label) => el("option", { value: label, selected: label === this.method }, label)),
    );
    choice.addEventListener("change", () => {
      // the same building by another method
      location.hash = addressOf({ job: this.job.jobID, method: choice.value, building: this.selected }, queryOf(location.hash));
    });
    const hasPage = this.job.links?.some(({ type }) => type === "text/html") === true;
    const page = pageLink(this.jobPath, "The methods side by side");
    page.classList.add("button", "quiet");
    return hasPage ? [choice, page] : [choice];
  }

  // --- the record of one building

  private address(building: string | null): string {
    const query = queryWith(queryOf(location.hash), this.wanted);
    return addressOf({ job: this.job.jobID, method: this.named, building }, query);
  }

  /** Handle a click in the scene: it changes the address, and the view follows the address. */
  private open(id: string | null): void {
    const hash = this.address(id);
    if (location.hash === hash) return;
    this.fromScene = id !== null;
    location.hash = hash;
  }

  private followAddress(): void {
    const place = this.place();
    if (place === null) return;
    const query = queryOf(location.hash);
    const wanted = wantedOf(new URLSearchParams(query));
    if (queryWith(query, wanted) !== queryWith(query, this.wanted)) {
      this.wanted = wanted;
      this.apply();
    }
    // else only the dossier opened or closed
    void this.chooseAddressed();
  }

  /** Show once more what the address asks for. */
  private readonly retry = (): void => {
    this.apply();
    void this.chooseAddressed();
  };

  /** What the address names; null if that is not of these results. */
  private place(): Place | null {
    const place = placeOf(location.hash);
    return place?.job === this.job.jobID && place.method === this.named ? place : null;
  }

  /** Select the object that the address names; one that is not a candidate may be among those that were left out. */
  private async chooseAddressed(): Promise<void> {
    const id = this.place()?.building;
    if (id === undefined || id === this.selected) return;
    const isKnown = id === null || this.listed.some((object) => object.id === id);
    if (!isKnown) {
      // it may come with the next buildings; it is looked for again once all are here
      if (!this.isLoaded) return;
      try {
        await this.loadRejected();
      } catch (error) {
        // without that table the record says whether there is such a building
        if (asProblem(error).status !== 404) {
          this.fail(error, this.retry);
          return;
        }
      }
    }
    // the address may have changed meanwhile, and led back here
    if (id === this.place()?.building && id !== this.selected) this.select(id);
  }

  private select(id: string | null): void {
    const before = this.selected;
    const fly = !this.fromScene;
    this.fromScene = false;
    this.stopRecord();
    this.selected = id;
    this.scene?.select(id, fly);
    this.map?.select(id, fly);
    if (id === null) {
      this.panel.replaceChildren(this.listView);
      this.list.returned();
      this.list.focus(before);
      return;
    }
    const body = el("div", { class: "record", "aria-live": "polite" });
    const step = (by: number) => () => {
      const next = this.list.beside(id, by);
      if (next !== null) location.hash = this.address(next);
    };
    const back = el("button", { type: "button", class: "quiet", onclick: () => this.open(null) }, "← All buildings");
    this.panel.replaceChildren(
      el(
        "div",
        { class: "record-bar" },
        back,
        el("span", { class: "spacer" }),
        el("button", { type: "button", class: "quiet", "aria-label": "Previous building", onclick: step(-1) }, "‹"),
        el("button", { type: "button", class: "quiet", "aria-label": "Next building", onclick: step(1) }, "›"),
      ),
      body,
    );
    this.panel.scrollTop = 0;
    if (!fly) this.panel.scrollIntoView({ block: "nearest" }); // on narrow screens it is below the models
    if (fly && before === null) back.focus({ preventScroll: true });
    const object = this.rejected.get(id);
    if (object !== undefined) {
      body.replaceChildren(...rejectedRecord(object));
      this.stopRecord = () => undefined;
      return;
    }
    this.stopRecord = showRecord(body, this.jobPath, this.method, id, elevationUnitM(this.report.crs), this.hooks.onProblem);
  }
}

/** A corner of the first outline, in whole units; null without outlines. */
function cornerOf(features: readonly Feature[]): [number, number, number] | null {
  for (const { geometry } of features) {
    const [easting, northing] = (geometry?.coordinates as unknown[] | undefined)?.flat(3) as number[] ?? [];
    if (typeof easting === "number" && typeof northing === "number") return [Math.round(easting), Math.round(northing), 0];
  }
  return null;
}
