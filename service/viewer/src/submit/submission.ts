/** The form of a new job: tiles are sent as soon as they are dropped, the job starts on the button. */

import { sendJson, type Problem } from "../api/requests";
import { el, svg, type Properties } from "../page/elements";
import { field } from "../page/form_fields";
import { announce, asProblem, problemNotice } from "../page/notices";
import { TABLES } from "../words/tables";
import { Options } from "./options";
import { SentFile, texts } from "./sent_file";
import { Unfinished } from "./unfinished";

/** Inputs that are files; all but the tiles are one file each. */
const INPUTS = ["tiles", "footprints", "guides"] as const;
type FileInput = (typeof INPUTS)[number];

/** The chosen files of an input, and their rows. */
class Chosen {
  files: SentFile[] = [];
  readonly rows = el("ul", { class: "files" });

  clear(): void {
    this.files = [];
    this.rows.replaceChildren();
  }
}

export class Submission {
  private readonly chosen = { tiles: new Chosen(), footprints: new Chosen(), guides: new Chosen() };
  private starting = false;
  /** The service refused the place of a tile by the CRS of the form. */
  private placeRefused = false;
  private readonly unfinished = new Unfinished();
  private readonly options: Options;
  private readonly note = el("div");
  private readonly go = el("button", { type: "submit", class: "primary wide" }, "Reconstruct");

  constructor(
    place: HTMLElement,
    private readonly onSubmitted: (jobId: string) => void,
    private readonly onProblem: (problem: Problem) => void,
  ) {
    const picker = this.picker("tiles", { multiple: true, accept: TABLES.endings.tiles, class: "visually-hidden" });
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
    const form = el("form", { novalidate: true }, title, picker, zone, this.unfinished.element, this.chosen.tiles.rows, this.options.element, this.note, this.go);
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
      this.add("tiles", [...(event.dataTransfer?.files ?? [])]);
    });
  }

  private picker(name: FileInput, properties: Properties): HTMLInputElement {
    const picker = el("input", { type: "file", id: name, ...properties });
    picker.addEventListener("change", () => {
      this.add(name, [...(picker.files ?? [])]);
      picker.value = "";
    });
    return picker;
  }

  /** The field for the file of an input, and the place of its row. */
  private vectorField(name: FileInput, hint: string): HTMLElement[] {
    const picker = this.picker(name, { accept: TABLES.endings.vectors });
    return [field(TABLES.inputs[name], picker, hint), this.chosen[name].rows];
  }

  private add(name: FileInput, files: File[]): void {
    const chosen = this.chosen[name];
    if (name !== "tiles" && files.length > 0) {
      for (const before of chosen.files) before.stop();
      chosen.clear();
    }
    for (const file of files) {
      this.unfinished.take(file);
      const sent: SentFile = new SentFile(file, {
        onEnd: () => {
          if (sent.faults.length > 0) this.options.element.open = true;
          this.draw();
        },
        onRemove: () => {
          chosen.files = chosen.files.filter((other) => other !== sent);
          this.draw();
        },
        onProblem: this.onProblem,
      });
      chosen.files.push(sent);
      chosen.rows.append(sent.row);
    }
    this.draw();
  }

  // --- the job

  private async submit(): Promise<void> {
    if (this.go.getAttribute("aria-disabled") === "true") return;
    this.starting = true;
    this.note.replaceChildren();
    this.draw();
    try {
      const [first = "", ...others] = this.chosen.tiles.files.map(({ file }) => file.name);
      const { process, inputs } = this.options.asked(others.length > 0 ? `${first} and ${others.length} more` : first);
      for (const name of INPUTS) {
        const links = this.chosen[name].files.map(({ uploaded }) => ({ href: uploaded?.href }));
        if (links.length > 0) inputs[name] = name === "tiles" ? links : links[0];
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
    for (const chosen of Object.values(this.chosen)) chosen.clear();
    this.options.clear();
    this.placeRefused = false;
  }

  private fail(problem: Problem): void {
    this.note.replaceChildren(problemNotice(problem));
    this.onProblem(problem);
  }

  /** Make the button say what is missing. */
  private draw(): void {
    const files = Object.values(this.chosen).flatMap((chosen) => chosen.files);
    const { tiles, footprints } = this.chosen;
    const isFar = tiles.files.some(({ preflight }) => typeof preflight["outsideAreaOfUse"] === "string");
    const [outlines] = footprints.files;
    this.options.draw(isFar || this.placeRefused, outlines === undefined ? null : texts(outlines.preflight["layers"]));
    const missing = this.missing(files, isFar);
    const { variants } = this.options;
    // not `disabled`: the button keeps its place in the tab order and its name says why it waits
    this.go.setAttribute("aria-disabled", String(missing !== null || tiles.files.length === 0));
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
