import { addressOf, ofRun, placeOf, type Place } from "./address";
import { getJson, request, type Feature, type StatusInfo } from "./api";
import type { Batch, Listed } from "./batching";
import { BuildingList } from "./building_list";
import { downloadMenu, pageLink } from "./downloads";
import { el } from "./elements";
import { failedFootprints } from "./failed_footprints";
import type { Hooks } from "./job_view";
import { titleOf } from "./job_list";
import { Legend } from "./legend";
import { LevelChoice } from "./level_choice";
import { loadModels, type FromLoading } from "./model_loading";
import { announce, asProblem, problemNotice, warningNotice } from "./notices";
import { count, counted, duration } from "./numbers";
import { showRecord } from "./record";
import { ModelScene } from "./scene";
import type { Category } from "./roof_types";

/** The part of the report that the page reads. */
interface Report {
  crs?: { name?: string | null; horizontal_unit_m?: number | null; vertical_unit_m?: number | null };
  counts?: Record<string, number>;
  timings_s?: Record<string, number>;
  warnings?: string[];
}

/** Show the results of a job: models, list, records and downloads. Returns a function that ends the view. */
export function showResults(place: HTMLElement, job: StatusInfo, named: Place, hooks: Hooks): () => void {
  const view = new ResultsView(place, job, named.method, hooks);
  view.start(named.building).catch((error: unknown) => view.fail(error));
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
  private readonly legend: Legend;
  private readonly levels = new LevelChoice((lod) => void this.showLevel(lod));
  private readonly counts = new Map<Category, number>();
  private readonly listed: Listed[] = [];
  private scene: ModelScene | null = null;
  private stopRecord: () => void = () => undefined;
  private otherLevel = new AbortController();
  private report: Report = {};
  private selected: string | null = null;
  private origin: readonly [number, number, number] = [0, 0, 0];
  private fromScene = false;

  constructor(
    place: HTMLElement,
    private readonly job: StatusInfo,
    private readonly named: string | null,
    private readonly hooks: Hooks,
  ) {
    this.methods = Object.keys(job.summary?.runs ?? {});
    this.method = named ?? this.methods[0] ?? null;
    this.jobPath = `jobs/${encodeURIComponent(job.jobID)}`;
    this.list = new BuildingList((id) => this.address(id));
    this.legend = new Legend((category, visible) => {
      this.scene?.show(category, visible);
      this.list.show(category, visible);
    });
    const view = el(
      "div",
      { class: "tool-group", role: "group", "aria-label": "View" },
      el("button", { type: "button", title: "Show all (f)", onclick: () => this.scene?.fit() }, "Fit"),
      el("button", { type: "button", title: "From above, north up (t)", onclick: () => this.scene?.top() }, "Top"),
    );
    this.panel.replaceChildren(this.list.element);
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
        el("div", { class: "stage3d" }, this.canvas, el("div", { class: "tools" }, this.levels.element, view), this.note),
        this.panel,
      ),
    );
  }

  async start(first: string | null): Promise<void> {
    window.addEventListener("hashchange", () => this.followAddress(), { signal: this.calledOff.signal });
    const [report, menu] = await Promise.all([this.loadReport(), downloadMenu(this.jobPath, this.method, this.calledOff.signal)]);
    if (this.calledOff.signal.aborted) return;
    this.report = report;
    this.downloads.replaceChildren(...this.comparison(), menu, this.removal());
    this.showFacts();
    try {
      this.scene = new ModelScene(this.canvas, (id) => this.open(id));
    } catch {
      this.note.replaceChildren(
        warningNotice("This browser cannot draw in 3D (WebGL is missing or switched off). The list, the records and the downloads still work."),
      );
    }
    this.note.append(el("p", { class: "loading" }, "Loading the models…"));
    const levels = await this.load(
      null,
      (message) => {
        if (message.kind === "frame") this.origin = message.origin;
        if (message.kind !== "buildings") return;
        this.take(message.listed);
        this.scene?.add(message.batches);
      },
      this.calledOff.signal,
    );
    await this.finished(first);
    if (this.scene !== null) this.levels.offer(levels);
  }

  fail(error: unknown): void {
    if (this.calledOff.signal.aborted) return;
    const problem = asProblem(error);
    this.note.replaceChildren(problemNotice(problem));
    this.hooks.onProblem(problem);
  }

  leave(): void {
    this.calledOff.abort();
    this.otherLevel.abort();
    this.stopRecord();
    this.scene?.dispose();
  }

  // --- loading

  /** The report; null if the request left it out. */
  private async loadReport(): Promise<Report> {
    try {
      return await getJson<Report>(ofRun(`${this.jobPath}/results/report`, this.method), { signal: this.calledOff.signal });
    } catch (error) {
      if (asProblem(error).status === 404) return {};
      throw error;
    }
  }

  /** Read the models at a level of detail, null for the finest of each; returns the available levels. */
  private load(lod: string | null, onMessage: (message: FromLoading) => void, signal: AbortSignal): Promise<string[]> {
    const { crs } = this.report;
    const reading = { horizontalUnitM: crs?.horizontal_unit_m ?? 1, verticalUnitM: crs?.vertical_unit_m ?? 1, lod };
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

  private take(listed: Listed[]): void {
    for (const building of listed) {
      this.listed.push(building);
      this.counts.set(building.category, (this.counts.get(building.category) ?? 0) + 1);
    }
    this.legend.set(this.counts);
    this.list.set(this.listed);
  }

  private async finished(first: string | null): Promise<void> {
    this.scene?.finish();
    this.note.querySelector(".loading")?.remove();
    this.showFacts();
    if (this.listed.length === 0) {
      this.note.replaceChildren(this.nothing());
      this.note.closest(".result")?.classList.add("result-empty");
      announce("No building was found.");
      return;
    }
    announce(`${counted(this.listed.length, "building")} loaded.`);
    if (this.counts.has("failed")) await this.drawFailed();
    if (first !== null) this.select(first);
    this.canvas.dataset["ready"] = "true";
  }

  /** Draw the footprints of buildings without a model: only the records have their place. */
  private async drawFailed(): Promise<void> {
    const { crs } = this.report;
    const failed = ofRun(`${this.jobPath}/buildings?status=failed&limit=10000&crs=native`, this.method);
    const page = await getJson<{ features: Feature[] }>(failed, {
      signal: this.calledOff.signal,
      headers: { Accept: "application/geo+json" },
    });
    const frame = {
      origin: this.origin,
      horizontalUnitM: crs?.horizontal_unit_m ?? 1,
      verticalUnitM: crs?.vertical_unit_m ?? 1,
    };
    const { scene } = this;
    if (scene === null) return;
    scene.add(failedFootprints(page.features, frame, (x, y) => scene.groundAt(x, y)));
  }

  private showFacts(): void {
    const tally = this.report.counts ?? {};
    const rejected = tally["rejected"];
    const points = tally["points"];
    const seconds = this.report.timings_s?.["total"];
    const warnings = this.report.warnings ?? [];
    const crsName = this.report.crs?.name ?? "unknown";
    const facts = [
      this.listed.length > 0 ? counted(this.listed.length, "building") : null,
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
    this.facts.replaceChildren(facts, warnings.length === 0 ? "" : " · ", warnings.length === 0 ? "" : notice);
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
          ? `${counted(rejected, "object")} ${rejected === 1 ? "was" : "were"} looked at and left out: too small, too low, too narrow, or vegetation. Each is in the download “rejected” with its reason and the measured figure.`
          : "Nothing rises above the ground.",
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
      location.hash = addressOf({ job: this.job.jobID, method: choice.value, building: this.selected });
    });
    const hasPage = this.job.links?.some(({ type }) => type === "text/html") === true;
    const page = pageLink(this.jobPath, "The methods side by side");
    page.classList.add("button", "quiet");
    return hasPage ? [choice, page] : [choice];
  }

  // --- the record of one building

  private address(building: string | null): string {
    return addressOf({ job: this.job.jobID, method: this.named, building });
  }

  /** Handle a click in the scene: it changes the address, and the view follows the address. */
  private open(id: string | null): void {
    const hash = this.address(id);
    if (location.hash === hash) return;
    this.fromScene = id !== null;
    location.hash = hash;
  }

  private followAddress(): void {
    const place = placeOf(location.hash);
    if (place?.job !== this.job.jobID || place.method !== this.named) return;
    this.select(place.building);
  }

  private select(id: string | null): void {
    const before = this.selected;
    const fly = !this.fromScene;
    this.fromScene = false;
    this.stopRecord();
    this.selected = id;
    this.scene?.select(id, fly);
    if (id === null) {
      this.panel.replaceChildren(this.list.element);
      if (before !== null) this.panel.querySelector<HTMLElement>(`a[href="${CSS.escape(this.address(before))}"]`)?.focus();
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
    this.stopRecord = showRecord(body, this.jobPath, this.method, id, unitName(this.report.crs?.vertical_unit_m), this.hooks.onProblem);
  }

  /** Remove the job and its results, after asking. */
  private removal(): HTMLElement {
    const button = el("button", { type: "button", class: "quiet" }, "Remove");
    button.addEventListener("click", () => {
      if (!confirm(`Remove “${titleOf(this.job)}” and its results from the service?`)) return;
      request(this.jobPath, { method: "DELETE" }).then(
        () => {
          this.hooks.onChange();
          location.hash = "#/";
        },
        (error: unknown) => this.fail(error),
      );
    });
    return button;
  }
}

function unitName(metres: number | null | undefined): string {
  if (metres == null || metres === 1) return "m";
  return Math.abs(metres - 0.3048) < 1e-5 ? "ft" : "";
}
