import { variantOf, sendJson } from "../api/requests";
import { Problem, getJson } from "../api/requests";
import type { UploadInfo } from "../api/types";
import { el, svg } from "../page/elements";
import { FORMATS, LABELS, capital } from "../words/fields";
import { choice, field } from "../page/form_fields";
import { type Interrupted, fingerprint, forget, interrupted, keyOf } from "./interrupted";
import { levelWords, levelsOffered, lodsInput } from "../models/levels_of_detail";
import { announce, asProblem, problemNotice, warningNotice } from "../page/notices";
import { bytes, count, measure, placeWords } from "../words/numbers";
import { SMALL_BYTES, send } from "./sending";

const TILE_ENDINGS = ".las,.laz,.ply,.xyz,.txt,.csv,.asc,.pts";
const VECTOR_ENDINGS = ".gpkg,.geojson,.json,.geojsonl,.geojsons,.ndjson,.parquet,.geoparquet,.fgb,.gml,.kml,.zip,.kmz";

/** Inputs that are one vector file each. */
const VECTORS = ["footprints", "guides"] as const;
type Vector = (typeof VECTORS)[number];
const VERTICAL_UNITS = { "": "as in the file", m: "metres", ft: "feet", "us-ft": "US survey feet" };

interface Sent {
  file: File;
  row: HTMLElement;
  calledOff: AbortController;
  uploaded: UploadInfo | null;
  share: number;
  /** Why nothing is sent at the moment. */
  waiting: string | null;
  problem: Problem | null;
}

interface InputDescription {
  schema: { enum?: string[]; default?: string; items?: { enum?: string[] } };
}

/** The form: tiles are sent as soon as they are dropped, the job starts on the button. */
export class Submission {
  private tiles: Sent[] = [];
  /** Files beside the tiles, one for each of these inputs. */
  private readonly vectors: Record<Vector, Sent | null> = { footprints: null, guides: null };
  private starting = false;
  private readonly rows = el("ul", { class: "files" });
  private readonly unfinished = el("ul", { class: "files", "aria-label": "Interrupted uploads" });
  private readonly vectorRows: Record<Vector, HTMLElement> = {
    footprints: el("ul", { class: "files" }),
    guides: el("ul", { class: "files" }),
  };
  private readonly layer = el("input", { id: "footprints-layer", type: "text", list: "footprints-layers", autocomplete: "off" });
  private readonly layers = el("datalist", { id: "footprints-layers" });
  private readonly layerField = field(LABELS.footprintsLayer, this.layer, "Only where the file has several.");
  private readonly note = el("div");
  private readonly go = el("button", { type: "submit", class: "primary wide" }, "Reconstruct");
  private readonly crs = el("input", { id: "crs", type: "text", placeholder: "EPSG:28992", autocomplete: "off", spellcheck: "false" });
  private readonly anywhere = el("input", { id: "anywhere", type: "checkbox", "aria-describedby": "anywhere-hint" });
  private readonly anywhereField = el(
    "div",
    { class: "field" },
    el("label", {}, this.anywhere, ` ${LABELS.allowOutsideAreaOfUse}`),
    el("p", { class: "hint", id: "anywhere-hint" }, "Only if the CRS is right: they are far from where it is used."),
  );
  /** The service refused the place of a tile by the CRS of the form. */
  private placeRefused = false;
  private readonly verticalUnit = choice("vertical-unit", VERTICAL_UNITS);
  private readonly method = choice("method", {});
  private readonly preset = choice("preset", {});
  private usualPreset = "";
  private readonly others = el("div", { class: "boxes" });
  private readonly levels = el("div", { class: "boxes" });
  private readonly levelsHint = el("p", { class: "hint", id: "lods-hint" });
  private readonly classes = choice("classes", {});
  private readonly points = el("input", { id: "with-points", type: "checkbox", "aria-describedby": "points-hint" });
  private readonly formats = el("div", { class: "boxes" });
  private readonly title = el("input", { id: "title", type: "text", autocomplete: "off", maxlength: 200 });
  private readonly options = el("details", { class: "options" });

  constructor(
    place: HTMLElement,
    private readonly onSubmitted: (jobId: string) => void,
    private readonly onProblem: (problem: Problem) => void,
  ) {
    const picker = el("input", { type: "file", id: "tiles", multiple: true, accept: TILE_ENDINGS, class: "visually-hidden" });
    picker.addEventListener("change", () => {
      this.addTiles([...(picker.files ?? [])]);
      picker.value = "";
    });
    const zone = el(
      "label",
      { class: "drop", for: "tiles" },
      svg("svg", { viewBox: "0 0 24 24", "aria-hidden": "true" }, svg("path", { d: "M12 16V4m-5 5 5-5 5 5M4 16v4h16v-4" })),
      el("span", { class: "drop-title" }, "Drop tiles here"),
      el("span", { class: "hint" }, "or choose files: LAS, LAZ, COPC, PLY, xyz"),
    );
    this.takeDrops(zone);
    this.options.append(
      el("summary", {}, "Options"),
      field(LABELS.crs, this.crs, "If the file has none or a wrong one."),
      this.anywhereField,
      field(LABELS.verticalUnit, this.verticalUnit),
      field(LABELS.method, this.method),
      field(LABELS.preset, this.preset, "Settings that measured better, or those of the method's paper."),
      el(
        "fieldset",
        { class: "field", "aria-describedby": this.levelsHint.id },
        el("legend", {}, "Levels of detail"),
        this.levels,
        this.levelsHint,
      ),
      el("fieldset", { class: "field" }, el("legend", {}, "Compare with"), this.others),
      field(LABELS.classes, this.classes, "Trusted, only compared with the result, or ignored."),
      field(LABELS.footprints, this.picker("footprints"), "GeoPackage, GeoJSON, GeoParquet, FlatGeobuf, GML or a zipped Shapefile: one model per polygon."),
      this.vectorRows.footprints,
      this.layerField,
      this.layers,
      field(LABELS.guides, this.picker("guides"), "Lines of roofs that models follow, in the same formats."),
      this.vectorRows.guides,
      el(
        "div",
        { class: "field" },
        el("label", {}, this.points, ` ${LABELS.points}`),
        el("p", { class: "hint", id: "points-hint" }, "To see them over the models, with their distances to the roofs. Takes longer."),
      ),
      el("fieldset", { class: "field" }, el("legend", {}, LABELS.publish), this.formats),
      field(LABELS.title, this.title),
    );
    for (const control of [this.method, this.preset, this.levels, this.anywhere]) {
      control.addEventListener("change", () => this.draw());
    }
    this.crs.addEventListener("input", () => this.draw());
    const form = el(
      "form",
      { novalidate: true },
      el("h2", { id: "submission-title" }, "New job"),
      picker,
      zone,
      this.unfinished,
      this.rows,
      this.options,
      this.note,
      this.go,
    );
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.submit();
    });
    place.replaceChildren(form);
    this.draw();
    void this.describe();
    void this.offerUnfinished();
  }

  /** Files that were not sent to their end before the page was left. */
  private async offerUnfinished(): Promise<void> {
    for (const one of await interrupted()) {
      const row = unfinishedRow(one, () => {
        row.remove();
        void forget(one.key);
      });
      row.dataset["key"] = one.key;
      if (!this.isSent(one.key)) this.unfinished.append(row);
    }
  }

  private isSent(key: string): boolean {
    const files = this.files();
    return files.some(({ file }) => keyOf(fingerprint(file)) === key);
  }

  /** Fill the choices from the process's own description. */
  private async describe(): Promise<void> {
    try {
      const process = await getJson<{ inputs: Record<string, InputDescription> }>("processes/reconstruct");
      const selects = [[this.method, "method"], [this.preset, "preset"], [this.classes, "classes"]] as const;
      for (const [select, name] of selects) {
        const schema = process.inputs[name]?.schema;
        select.replaceChildren(
          ...(schema?.enum ?? []).map((value) => el("option", { value, selected: value === schema?.default }, value)),
        );
      }
      this.usualPreset = this.preset.value;
      const lods = process.inputs["lods"]?.schema;
      this.offerLevels(levelsOffered(lods?.enum ?? []), levelsOffered([lods?.default ?? ""]));
      this.offerFormats(process.inputs["publish"]?.schema.items?.enum ?? []);
      const comparison = await getJson<{ inputs: Record<string, InputDescription> }>("processes/compare");
      this.offerOthers(comparison.inputs["methods"]?.schema.items?.enum ?? []);
    } catch (error) {
      this.tell(asProblem(error));
    }
  }

  /** A box for every method with each of its presets: a set box makes the job a comparison. */
  private offerOthers(variants: string[]): void {
    const words = variants.filter((variant) => !variant.endsWith(`:${this.usualPreset}`));
    this.others.replaceChildren(
      ...words.map((value) => el("label", {}, el("input", { type: "checkbox", value }), ` ${value.replace(":", ", ")}`)),
    );
    this.others.addEventListener("change", () => this.draw());
    this.draw();
  }

  /** A box for every level of detail. */
  private offerLevels(lods: string[], usual: string[]): void {
    this.levels.replaceChildren(
      ...lods.map((value) =>
        el(
          "label",
          {},
          el("input", { type: "checkbox", name: "lods", value, checked: usual.includes(value) }),
          ` LoD${value}: ${levelWords(value)}`,
        ),
      ),
    );
    this.draw();
  }

  /** A box for every further format. */
  private offerFormats(formats: string[]): void {
    this.formats.replaceChildren(
      ...formats.map((value) => el("label", {}, el("input", { type: "checkbox", value }), ` ${FORMATS[value] ?? value}`)),
    );
    this.draw();
  }

  /** The chosen levels of detail, as the process takes them; empty if none is chosen. */
  private lods(): string {
    return lodsInput([...this.levels.querySelectorAll<HTMLInputElement>("input:checked")].map(({ value }) => value));
  }

  /** All methods to run; more than one is a comparison. */
  private variants(): string[] {
    const boxes = [...this.others.querySelectorAll<HTMLInputElement>("input:checked")];
    return [...new Set([this.chosen(), ...boxes.map(({ value }) => value)])];
  }

  private chosen(): string {
    return variantOf(this.method.value, this.preset.value, this.usualPreset);
  }

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

  /** The field for the file of an input. */
  private picker(name: Vector): HTMLInputElement {
    const picker = el("input", { type: "file", id: name, accept: VECTOR_ENDINGS });
    picker.addEventListener("change", () => {
      const file = picker.files?.[0];
      if (file !== undefined) this.setVector(name, file);
      picker.value = "";
    });
    return picker;
  }

  private setVector(name: Vector, file: File): void {
    this.vectors[name]?.calledOff.abort();
    const sent = this.send(file, () => {
      this.vectors[name] = null;
    });
    this.vectors[name] = sent;
    this.vectorRows[name].replaceChildren(sent.row);
    this.draw();
  }

  /** All files of the form. */
  private files(): Sent[] {
    return [...this.tiles, ...Object.values(this.vectors).filter((sent) => sent !== null)];
  }

  /** Begin to send a file; its row shows the progress and the result of the examination. */
  private send(file: File, forget: () => void): Sent {
    const sent: Sent = {
      file,
      row: el("li", { class: "file" }),
      calledOff: new AbortController(),
      uploaded: null,
      share: 0,
      waiting: null,
      problem: null,
    };
    const remove = (): void => {
      sent.calledOff.abort();
      forget();
      sent.row.remove();
      this.draw();
    };
    const draw = (): void => drawRow(sent, remove);
    draw();
    for (const row of [...this.unfinished.children]) {
      if (row instanceof HTMLElement && row.dataset["key"] === keyOf(fingerprint(file))) row.remove();
    }
    const report = {
      progress: (share: number): void => {
        sent.share = share;
        draw();
      },
      waiting: (reason: string | null): void => {
        if (reason === sent.waiting) return;
        sent.waiting = reason;
        announce(reason === null ? `${file.name} is being sent.` : `${file.name}: ${reason}`);
        draw();
      },
    };
    send(file, report, sent.calledOff.signal).then(
      (uploaded) => {
        sent.uploaded = uploaded;
        const problems = texts(uploaded.preflight["problems"]);
        if (problems.length > 0) this.options.open = true;
        announce(`${file.name} is uploaded. ${problems.join(" ")}`);
        draw();
        this.draw();
      },
      (error: unknown) => {
        if (sent.calledOff.signal.aborted) return;
        sent.problem = asProblem(error);
        this.onProblem(sent.problem);
        draw();
        this.draw();
      },
    );
    return sent;
  }

  private async submit(): Promise<void> {
    if (this.go.getAttribute("aria-disabled") === "true") return;
    this.starting = true;
    this.note.replaceChildren();
    this.draw();
    try {
      const names = this.tiles.map(({ file }) => file.name);
      const inputs: Record<string, unknown> = {
        tiles: this.tiles.map(({ uploaded }) => ({ href: uploaded?.href })),
        title: this.title.value.trim() || (names.length > 1 ? `${names[0]} and ${names.length - 1} more` : names[0]),
      };
      const chosen: [string, string][] = [
        ["crs", this.crs.value.trim()],
        ["footprintsLayer", this.layerField.hidden ? "" : this.layer.value.trim()],
        ["verticalUnit", this.verticalUnit.value],
        ["classes", this.classes.value],
      ];
      const variants = this.variants();
      if (variants.length > 1) inputs["methods"] = variants;
      else {
        chosen.push(["method", this.method.value], ["preset", this.preset.value], ["lods", this.lods()]);
        if (this.points.checked) inputs["points"] = true;
        const formats = [...this.formats.querySelectorAll<HTMLInputElement>("input:checked")].map(({ value }) => value);
        if (formats.length > 0) inputs["publish"] = formats;
      }
      for (const [name, value] of chosen) if (value !== "") inputs[name] = value;
      if (this.anywhere.checked) inputs["allowOutsideAreaOfUse"] = true;
      for (const name of VECTORS) {
        const uploaded = this.vectors[name]?.uploaded;
        if (uploaded != null) inputs[name] = { href: uploaded.href };
      }
      const response = await sendJson("POST", `processes/${variants.length > 1 ? "compare" : "reconstruct"}/execution`, { inputs });
      const { jobID } = (await response.json()) as { jobID: string };
      this.clear();
      announce("The job is submitted.");
      this.onSubmitted(jobID);
    } catch (error) {
      const problem = asProblem(error);
      this.placeRefused = problem.kind === "outside-area-of-use";
      if (this.placeRefused) this.options.open = true;
      this.tell(problem);
    } finally {
      this.starting = false;
      this.draw();
    }
  }

  /** Offer the layers of the footprints, as far as the service knows them. */
  private offerLayers(): void {
    const footprints = this.vectors.footprints;
    this.layerField.hidden = footprints === null;
    const known = texts(footprints?.uploaded?.preflight["layers"]);
    this.layers.replaceChildren(...known.map((value) => el("option", { value })));
  }

  private clear(): void {
    this.tiles = [];
    for (const name of VECTORS) {
      this.vectors[name] = null;
      this.vectorRows[name].replaceChildren();
    }
    this.layer.value = "";
    this.title.value = "";
    this.placeRefused = false;
    this.anywhere.checked = false;
    this.rows.replaceChildren();
  }

  private tell(problem: Problem): void {
    this.note.replaceChildren(problemNotice(problem));
    this.onProblem(problem);
  }

  /** Make the button say what is missing. */
  private draw(): void {
    const files = this.files();
    const refused = files.some(({ problem }) => problem !== null);
    const waiting = files.some(({ uploaded, problem }) => uploaded === null && problem === null);
    const comparison = this.variants().length > 1;
    const levelBoxes = [...this.levels.querySelectorAll("input")];
    const noLevel = !comparison && levelBoxes.length > 0 && this.lods() === "";
    const isFar = this.tiles.some(({ uploaded }) => typeof uploaded?.preflight["outsideAreaOfUse"] === "string");
    this.anywhereField.hidden = !isFar && !this.placeRefused;
    if (this.anywhereField.hidden) this.anywhere.checked = false;
    // by another CRS the tiles lie elsewhere, which the service finds out
    this.offerLayers();
    const unplaced = isFar && this.crs.value.trim() === "" && !this.anywhere.checked;
    const ready = this.tiles.length > 0 && !refused && !waiting && !noLevel && !unplaced && !this.starting;
    for (const box of [...levelBoxes, ...this.formats.querySelectorAll("input"), this.points]) box.disabled = comparison;
    this.levelsHint.textContent = comparison ? "Comparisons are made at LoD2.2." : "One or several; the records describe the finest.";
    const chosen = this.chosen();
    for (const box of this.others.querySelectorAll("input")) box.disabled = box.value === chosen;
    // not `disabled`: the button keeps its place in the tab order and its name says why it waits
    this.go.setAttribute("aria-disabled", String(!ready));
    this.go.textContent = this.starting
      ? "Submitting…"
      : waiting
        ? "Uploading…"
        : refused
          ? "Remove what was refused"
          : unplaced
            ? "Correct the CRS"
            : comparison
              ? `Compare ${this.variants().length} methods`
              : noLevel
                ? "Choose a level of detail"
                : "Reconstruct";
  }
}

function drawRow(sent: Sent, remove: () => void): void {
  const { file, uploaded, problem, row } = sent;
  const head = el(
    "div",
    { class: "file-head" },
    el("span", { class: "file-name" }, file.name),
    el("span", { class: "file-size" }, bytes(file.size)),
    el("button", { type: "button", class: "icon", "aria-label": `Remove ${file.name}`, onclick: remove }, "×"),
  );
  if (problem !== null) {
    row.replaceChildren(head, problemNotice(problem));
  } else if (uploaded === null) {
    // keep the same element: screen readers and transitions keep their place
    const bar = row.querySelector("progress") ?? el("progress", { max: 1, "aria-label": `Upload of ${file.name}` });
    bar.value = sent.share;
    const words = row.querySelector(".sent") ?? el("p", { class: "facts sent" });
    words.textContent = sent.waiting ?? sentWords(file.size, sent.share);
    if (!bar.isConnected) row.replaceChildren(head, bar, ...(file.size > SMALL_BYTES ? [words] : []));
  } else {
    row.replaceChildren(head, ...preflight(uploaded.preflight));
  }
}

function sentWords(size: number, share: number): string {
  return share < 1 ? `${bytes(size * share)} of ${bytes(size)} are sent` : "All is sent, it is being examined";
}

function unfinishedRow({ name, size, offset }: Interrupted, remove: () => void): HTMLElement {
  return el(
    "li",
    { class: "file" },
    el(
      "div",
      { class: "file-head" },
      el("span", { class: "file-name" }, name),
      el("span", { class: "file-size" }, bytes(size)),
      el("button", { type: "button", class: "icon", "aria-label": `Forget ${name}`, onclick: remove }, "×"),
    ),
    el("progress", { max: 1, value: offset / size, "aria-label": `Upload of ${name}` }),
    el("p", { class: "facts" }, `${bytes(offset)} of ${bytes(size)} are sent. Choose the file again to continue.`),
  );
}

/** The facts that the service read in the header. */
function preflight(known: Record<string, unknown>): HTMLElement[] {
  const crs = known["crs"] as { name?: string; epsg?: number | null } | null | undefined;
  const crsText = crs == null ? "no CRS" : crs.epsg == null ? (crs.name ?? "CRS without a code") : `EPSG:${crs.epsg}`;
  const facts =
    known["kind"] !== "points"
      ? [typeof known["featureCount"] === "number" ? `${count(known["featureCount"])} ${known["kind"] === "guides" ? "lines" : "outlines"}` : null, crsText]
      : [
          typeof known["pointCount"] === "number" ? `${count(known["pointCount"])} points` : null,
          typeof known["densityPerM2"] === "number" ? measure(known["densityPerM2"], 1, "per m²") : null,
          crsText,
        ];
  const notes = [...texts(known["problems"]), ...texts(known["warnings"])].map(capital);
  const place = placeWords(known["place"]);
  return [
    el("p", { class: "facts", title: crs?.name ?? null }, facts.filter((fact) => fact !== null).join(" · ")),
    place === null ? null : el("p", { class: "place" }, `Lies at ${place}`),
    notes.length === 0 ? null : warningNotice(...notes),
  ].filter((part) => part !== null);
}

function texts(value: unknown): string[] {
  return Array.isArray(value) ? value.filter((entry) => typeof entry === "string") : [];
}
