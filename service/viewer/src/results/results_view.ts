import { pathOfJob } from "../api/requests";
import type { Feature, StatusInfo } from "../api/types";
import { downloadMenu, pageLink } from "../jobs/downloads";
import { jobMenu } from "../jobs/job_actions";
import { titleOf } from "../jobs/job_words";
import { OutlineMap } from "../map/outline_map";
import type { Batch, Listed } from "../models/batching";
import { outlineColour, type Colouring } from "../models/colouring";
import { flatOutlines } from "../models/failed_footprints";
import { FIGURE_NAMES } from "../models/figures";
import type { Outline } from "../models/outlines";
import { RunObjects } from "../models/run_objects";
import { isFiltered, queryWith, selected, tallies, USUAL, wantedOf, type Wanted } from "../models/selection";
import { elevationUnitM } from "../models/units";
import { addressOf, placeOf, queryOf, type Place } from "../page/address";
import { button, el, setPressed } from "../page/elements";
import { announce, asProblem, report, warningNotice } from "../page/notices";
import { ModelScene } from "../scene/scene";
import { ViewTools } from "../tools/view_tools";
import { counted } from "../words/numbers";
import { CATEGORIES, CATEGORY_NAMES } from "../words/roof_types";
import { BuildingList, tallyWords } from "./building_list";
import { changed, FilterPanel } from "./filter_panel";
import { Legend } from "./legend";
import { LevelChoice } from "./level_choice";
import { Panel } from "./panel";
import { rejectedRecord, showRecord } from "./record";
import { nothingFound, resultFacts } from "./result_facts";

/** Show the results of a job: models, list, records and downloads. Returns a function that ends the view. */
export function showResults(place: HTMLElement, job: StatusInfo, named: Place): () => void {
  const view = new ResultsView(place, job, named.method);
  view.start().catch((error: unknown) => view.fail(error));
  return () => view.leave();
}

class ResultsView {
  private readonly calledOff = new AbortController();
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
  private readonly panel: Panel;
  private readonly list: BuildingList;
  private readonly filters = new FilterPanel((wanted) => this.change(wanted));
  private readonly legend: Legend;
  private readonly levels = new LevelChoice((lod) => void this.showLevel(lod));
  private readonly viewTools: ViewTools;
  private readonly objects: RunObjects;
  private loadingRejected: Promise<void> | null = null;
  private wanted: Wanted = USUAL;
  private shown: Listed[] = [];
  private scene: ModelScene | null = null;
  private colouring: Colouring = "type";
  private readonly stage: HTMLElement;
  private readonly map = new OutlineMap((id) => this.open(id));
  private isLaid = false;
  private readonly top = button("Top", () => this.scene?.top(), { title: "From above, north up (t)" });
  private readonly modes = {
    "3d": button("3D", () => this.change({ ...this.wanted, map: false })),
    map: button("Map", () => this.change({ ...this.wanted, map: true })),
  };
  private otherLevel = new AbortController();
  private selected: string | null = null;
  private fromScene = false;
  private isLoaded = false;

  constructor(
    place: HTMLElement,
    private readonly job: StatusInfo,
    private readonly named: string | null,
  ) {
    this.methods = Object.keys(job.summary?.runs ?? {});
    this.method = named ?? this.methods[0] ?? null;
    this.objects = new RunObjects(pathOfJob(job.jobID), this.method);
    this.viewTools = new ViewTools(this.objects);
    this.list = new BuildingList((id) => this.address(id));
    this.legend = new Legend(
      (category, visible) => {
        this.change({ ...this.wanted, hidden: changed(this.wanted.hidden, [category], !visible) });
      },
      (colouring) => {
        this.colouring = colouring;
        this.scene?.models.colourBy(colouring);
        this.colourMap();
      },
    );
    const fit = button("Fit", () => (this.wanted.map ? this.map : this.scene)?.fit(), { title: "Show all (f)" });
    const mode = el("div", { class: "tool-group", role: "group", "aria-label": "3D or map" }, ...Object.values(this.modes));
    const view = el("div", { class: "tool-group", role: "group", "aria-label": "View" }, fit, this.top);
    this.panel = new Panel(this.filters.element, this.list, (id) => {
      location.hash = this.address(id);
    });
    this.stage = el("div", { class: "stage3d" }, this.canvas, this.viewTools.cards, this.viewTools.bar(this.levels.element, mode, view), this.note);
    this.colourMap();
    place.replaceChildren(
      el(
        "div",
        { class: "result" },
        el("div", { class: "result-head" }, el("div", { class: "result-title" }, el("h1", {}, titleOf(job)), this.facts), this.downloads),
        this.legend.element,
        this.stage,
        this.panel.element,
      ),
    );
  }

  async start(): Promise<void> {
    window.addEventListener("hashchange", () => this.followAddress(), { signal: this.calledOff.signal });
    const { summary } = this.job;
    const statuses = (this.method === null ? summary : summary?.runs?.[this.method])?.statuses ?? {};
    const [menu] = await Promise.all([
      downloadMenu(this.objects, statuses, this.calledOff.signal),
      this.objects.readReport(this.calledOff.signal),
    ]);
    if (this.calledOff.signal.aborted) return;
    this.wanted = wantedOf(new URLSearchParams(queryOf(location.hash)));
    this.apply();
    this.downloads.replaceChildren(...this.comparison(), menu, jobMenu(this.job));
    this.facts.replaceChildren(...resultFacts(this.objects));
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
    const levels = await this.objects.readModels(
      null,
      ({ batches, listed, outlines }) => {
        this.scene?.add(batches);
        this.take(listed, outlines);
      },
      this.calledOff.signal,
    );
    await this.finished(levels);
  }

  /** Say what went wrong; `again` tries it once more. */
  fail(error: unknown, again?: () => void): void {
    if (this.calledOff.signal.aborted) return;
    const retry = (): void => {
      this.note.replaceChildren();
      again?.();
    };
    report(this.note, error, again && retry);
  }

  leave(): void {
    this.calledOff.abort();
    this.otherLevel.abort();
    this.panel.leave();
    this.viewTools.leave();
    this.scene?.dispose();
    this.map.dispose();
  }

  // --- loading

  /** Show the models at another level of detail from the same place; the old ones stay until the new ones are read. */
  private async showLevel(lod: string): Promise<void> {
    this.otherLevel.abort();
    const { signal } = (this.otherLevel = new AbortController());
    const batches: Batch[] = [];
    this.note.replaceChildren(el("p", { class: "loading" }, `Loading LoD${lod}…`));
    try {
      await this.objects.readModels(lod, (message) => void batches.push(...message.batches), signal);
    } catch (error) {
      if (!signal.aborted) this.fail(error);
      return;
    }
    this.note.replaceChildren();
    this.scene?.models.replace(batches);
    this.scene?.select(this.selected, false);
    this.levels.mark(lod);
    announce(`LoD${lod} is shown.`);
  }

  private take(listed: Listed[], outlines: Outline[]): void {
    this.objects.add(listed);
    this.map.add(outlines);
    this.apply();
  }

  private async finished(levels: string[]): Promise<void> {
    this.scene?.finish();
    this.note.querySelector(".loading")?.remove();
    this.facts.replaceChildren(...resultFacts(this.objects));
    this.isLoaded = true;
    if (this.objects.listed.length === 0) {
      this.note.replaceChildren(nothingFound(this.objects.report));
      this.note.closest(".result")?.classList.add("result-empty");
      announce("No building was found.");
      this.apply();
      await this.chooseAddressed();
      return;
    }
    announce(`${counted(this.objects.listed.length, "building")} loaded.`);
    const offered = this.viewTools.offerPoints();
    if (this.objects.counts.has("failed")) {
      await offered; // outlines lie on the terrain
      try {
        this.takeOutlines(await this.objects.failed(this.calledOff.signal), "failed");
      } catch (error) {
        this.fail(error);
      }
    }
    if (this.calledOff.signal.aborted) return;
    this.apply();
    await this.chooseAddressed();
    if (this.scene !== null) this.levels.offer(levels);
    await offered;
    this.canvas.dataset["ready"] = "true";
  }

  /** Draw objects without a model. */
  private takeOutlines(features: readonly Feature[], status: "failed" | "rejected"): void {
    const { scene } = this;
    const { batches, listed, outlines } = flatOutlines(features, status, this.objects.frame, (x, y) => scene?.groundAt(x, y) ?? 0);
    scene?.add(batches);
    this.take(status === "rejected" ? listed : [], outlines);
  }

  // --- filters, order and the map

  /** Show something else, and name it in the address. */
  private change(wanted: Wanted): void {
    this.wanted = wanted;
    history.replaceState(history.state, "", this.address(this.selected));
    this.apply();
    announce(`${tallyWords(this.shown.length, this.objects.listed.length)} objects are listed.`);
  }

  /** Bring the list, the legend, the 3D view and the map to what is wanted. */
  private apply(): void {
    const { wanted } = this;
    const counts = tallies(this.objects.listed, wanted);
    if (this.loadingRejected === null) counts.categories.set("rejected", this.objects.counts.get("rejected") ?? 0);
    for (const category of CATEGORY_NAMES) {
      // a category that the other filters empty stays in the filters
      if ((this.objects.counts.get(category) ?? 0) > 0 && !counts.categories.has(category)) counts.categories.set(category, 0);
    }
    this.shown = selected(this.objects.listed, wanted);
    const all = CATEGORY_NAMES.reduce((n, name) => n + (wanted.hidden.has(name) ? 0 : (this.objects.counts.get(name) ?? 0)), 0);
    const figure = FIGURE_NAMES.find((name) => name === wanted.sort) ?? null;
    this.list.set(this.shown, figure, this.objects.listed.length === 0 ? "" : "No object fits these filters.");
    this.filters.set(wanted, { shown: this.shown.length, all, ...counts });
    this.legend.set(this.objects.counts, wanted.hidden, this.shown);
    const only = isFiltered(wanted) ? new Set(this.shown.map(({ id }) => id)) : null;
    this.scene?.models.showOnly(only);
    this.map.showOnly(only);
    if (!this.isLoaded) return;
    if (!wanted.hidden.has("rejected")) void this.loadRejected().catch((error: unknown) => this.fail(error, this.retry));
    this.showMap(wanted.map).catch((error: unknown) => this.fail(error));
  }

  /** Load the objects that were left out, unless they are there already. */
  private loadRejected(): Promise<void> {
    const load = async (): Promise<void> => {
      if (this.objects.counts.get("rejected") === 0) return;
      const features = await this.objects.readRejected(this.calledOff.signal);
      this.stage.closest(".result-empty")?.classList.remove("result-empty");
      this.note.querySelector(".card")?.remove();
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
    setPressed(this.modes["3d"], !wanted);
    setPressed(this.modes.map, wanted);
    this.top.hidden = wanted;
    this.canvas.hidden = wanted;
    this.levels.element.classList.toggle("levels-away", wanted);
    this.viewTools.setAway(wanted);
    const { element } = this.map;
    if (!wanted) element.remove();
    if (!wanted || element.isConnected) return;
    this.stage.prepend(element);
    this.map.select(this.selected, this.selected !== null);
    if (this.isLaid || document.querySelector('meta[name="map-tiles"]') === null) return;
    const { layBackground } = await import("../map/background");
    await layBackground(this.map, this.objects, this.calledOff.signal);
    this.isLaid = true;
  }

  /** Colour the map as the models are, also objects that are still to come. */
  private colourMap(): void {
    this.map.colourBy(({ id, category }) => {
      const object = this.objects.find(id);
      return object === undefined ? CATEGORIES[category].colour : outlineColour(this.colouring, object);
    });
  }

  // --- the methods of a comparison

  /** The choice of the method whose models are shown, and the link to the page with all methods. */
  private comparison(): HTMLElement[] {
    if (this.methods.length === 0) return [];
    // the same building by another method
    const follow = (): void => {
      location.hash = addressOf({ job: this.job.jobID, method: select.value, building: this.selected }, queryOf(location.hash));
    };
    const options = this.methods.map((label) => el("option", { value: label, selected: label === this.method }, label));
    const select = el("select", { "aria-label": "Models of the method", onchange: follow }, ...options);
    const hasPage = this.job.links?.some(({ type }) => type === "text/html") === true;
    const page = pageLink(this.objects.jobPath, "The methods side by side");
    page.classList.add("button", "quiet");
    return hasPage ? [select, page] : [select];
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
    const isKnown = id === null || this.objects.listed.some((object) => object.id === id);
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
    this.selected = id;
    this.scene?.select(id, fly);
    this.map.select(id, fly);
    if (id === null) return this.panel.showList(before);
    this.panel.showRecord(id, !fly, before === null, (body) => {
      const object = this.objects.find(id);
      if (object?.category !== "rejected") return showRecord(body, this.objects, id, elevationUnitM(this.objects.report.crs));
      body.replaceChildren(...rejectedRecord(object));
      return () => undefined;
    });
  }
}
