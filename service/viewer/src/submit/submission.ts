/** The form of a new job: tiles are sent as soon as they are dropped, the job starts on the button. */

import { sendJson, type Problem } from "../api/requests";
import { el, svg } from "../page/elements";
import { field } from "../page/form_fields";
import { announce, asProblem, problemNotice } from "../page/notices";
import { TABLES } from "../words/tables";
import { Options } from "./options";
import { SentFile, texts } from "./sent_file";
import { Unfinished } from "./unfinished";

/** Inputs that are one vector file each. */
const VECTORS = ["footprints", "guides"] as const;
type Vector = (typeof VECTORS)[number];

export class Submission {
  private tiles: SentFile[] = [];
  /** Files beside the tiles, one for each of these inputs. */
  private readonly vectors: Record<Vector, SentFile | null> = { footprints: null, guides: null };
  private starting = false;
  /** The service refused the place of a tile by the CRS of the form. */
  private placeRefused = false;
  private readonly rows = el("ul", { class: "files" });
  private readonly vectorRows: Record<Vector, HTMLElement> = {
    footprints: el("ul", { class: "files" }),
    guides: el("ul", { class: "files" }),
  };
  private readonly unfinished = new Unfinished();
  private readonly options: Options;
  private readonly note = el("div");
  private readonly go = el("button", { type: "submit", class: "primary wide" }, "Reconstruct");

  constructor(
    place: HTMLElement,
    private readonly onSubmitted: (jobId: string) => void,
    private readonly onProblem: (problem: Problem) => void,
  ) {
    const picker = el("input", { type: "file", id: "tiles", multiple: true, accept: TABLES.endings.tiles, class: "visually-hidden" });
    picker.addEventListener("change", () => {
      this.addTiles([...(picker.files ?? [])]);
      picker.value = "";
    });
    const zone = el(
      "label",
      { class: "drop", for: "tiles" },
      svg("svg", { viewBox: "0 0 24 24", "aria-hidden": "true" }, svg("path", { d: "M12 16V4m-5 5 5-5 5 5M4 16v4h16v-4" })),
      el("span", { class: "drop-title" }, "Drop tiles here"),
      el("span", { class: "hint" }, `or choose files: ${TABLES.endings.tiles.replaceAll(",", " ")}`),
    );
    this.takeDrops(zone);
    const files = [
      ...this.vectorField("footprints", "GeoPackage, GeoJSON, GeoParquet, FlatGeobuf, GML or a zipped Shapefile: one model per polygon."),
      ...this.vectorField("guides", "Lines of roofs that models follow, in the same formats."),
    ];
    this.options = new Options(files, () => this.draw());
    const title = el("h2", { id: "submission-title" }, "New job");
    const form = el("form", { novalidate: true }, title, picker, zone, this.unfinished.element, this.rows, this.options.element, this.note, this.go);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.submit();
    });
    place.replaceChildren(form);
    this.draw();
    this.options.describe().then(
      () => this.draw(),
      (error: unknown) => this.fail(asProblem(error)),
    );
  }

  // --- files

  /** Files may be dropped anywhere: a drop beside the form must not replace the page by the file. */
  private takeDrops(zone: HTMLElement): void {
    let depth = 0;
    const over = (on: boolean): void => void zone.classList.toggle("over", on);
    document.addEventListener("dragenter", (event) => {
      event.preventDefault();
      depth += 1;
      over(true);
    });
    document.addEventListener("dragleave", () => {
      depth -= 1;
      if (depth <= 0) over(false);
    });
    document.addEventListener("dragover", (event) => event.preventDefault());
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      depth = 0;
      over(false);
      this.addTiles([...(event.dataTransfer?.files ?? [])]);
    });
  }

  private addTiles(files: File[]): void {
    for (const file of files) {
      const sent = this.send(file, () => {
        this.tiles = this.tiles.filter((other) => other !== sent);
      });
      this.tiles.push(sent);
      this.rows.append(sent.row);
    }
    this.draw();
  }

  /** The field for the file of an input, and the place of its row. */
  private vectorField(name: Vector, hint: string): HTMLElement[] {
    const picker = el("input", { type: "file", id: name, accept: TABLES.endings.vectors });
    picker.addEventListener("change", () => {
      const file = picker.files?.[0];
      if (file !== undefined) this.setVector(name, file);
      picker.value = "";
    });
    return [field(TABLES.inputs[name], picker, hint), this.vectorRows[name]];
  }

  private setVector(name: Vector, file: File): void {
    this.vectors[name]?.stop();
    const sent = this.send(file, () => {
      this.vectors[name] = null;
    });
    this.vectors[name] = sent;
    this.vectorRows[name].replaceChildren(sent.row);
    this.draw();
  }

  private send(file: File, forget: () => void): SentFile {
    this.unfinished.take(file);
    const sent: SentFile = new SentFile(file, {
      onEnd: () => {
        if (sent.faults.length > 0) this.options.element.open = true;
        this.draw();
      },
      onRemove: () => {
        forget();
        this.draw();
      },
      onProblem: this.onProblem,
    });
    return sent;
  }

  // --- the job

  private async submit(): Promise<void> {
    if (this.go.getAttribute("aria-disabled") === "true") return;
    this.starting = true;
    this.note.replaceChildren();
    this.draw();
    try {
      const [first = "", ...others] = this.tiles.map(({ file }) => file.name);
      const { process, inputs } = this.options.asked(others.length > 0 ? `${first} and ${others.length} more` : first);
      inputs["tiles"] = this.tiles.map(({ uploaded }) => ({ href: uploaded?.href }));
      for (const name of VECTORS) {
        const uploaded = this.vectors[name]?.uploaded;
        if (uploaded != null) inputs[name] = { href: uploaded.href };
      }
      const response = await sendJson("POST", `processes/${process}/execution`, { inputs });
      const { jobID } = (await response.json()) as { jobID: string };
      this.clear();
      announce("The job is submitted.");
      this.onSubmitted(jobID);
    } catch (error) {
      const problem = asProblem(error);
      this.placeRefused = problem.kind === "outside-area-of-use";
      if (this.placeRefused) this.options.element.open = true;
      this.fail(problem);
    } finally {
      this.starting = false;
      this.draw();
    }
  }

  private clear(): void {
    this.tiles = [];
    for (const name of VECTORS) {
      this.vectors[name] = null;
      this.vectorRows[name].replaceChildren();
    }
    this.options.clear();
    this.placeRefused = false;
    this.rows.replaceChildren();
  }

  private fail(problem: Problem): void {
    this.note.replaceChildren(problemNotice(problem));
    this.onProblem(problem);
  }

  /** Make the button say what is missing. */
  private draw(): void {
    const { footprints, guides } = this.vectors;
    const files = [...this.tiles, footprints, guides].filter((sent) => sent !== null);
    const isFar = this.tiles.some(({ preflight }) => typeof preflight["outsideAreaOfUse"] === "string");
    this.options.draw(isFar || this.placeRefused, footprints === null ? null : texts(footprints.preflight["layers"]));
    const missing = this.missing(files, isFar);
    const { variants } = this.options;
    // not `disabled`: the button keeps its place in the tab order and its name says why it waits
    this.go.setAttribute("aria-disabled", String(missing !== null || this.tiles.length === 0));
    this.go.textContent = missing ?? (variants.length > 1 ? `Compare ${variants.length} methods` : "Reconstruct");
  }

  /** What the job waits for, beside a tile; null for nothing. */
  private missing(files: readonly SentFile[], isFar: boolean): string | null {
    if (this.starting) return "Submitting…";
    if (files.some(({ uploaded, problem }) => uploaded === null && problem === null)) return "Uploading…";
    if (files.some(({ problem }) => problem !== null)) return "Remove what was refused";
    // by another CRS the tiles lie elsewhere, which the service finds out
    if (isFar && this.options.refusesPlaces) return "Correct the CRS";
    return this.options.lacksLevel ? "Choose a level of detail" : null;
  }
}
