/** The options of a new job, as the service describes them. */

import { getJson, variantOf } from "../api/requests";
import type { InputDescription } from "../api/types";
import { levelsOffered, levelWords, lodsInput } from "../models/levels_of_detail";
import { el } from "../page/elements";
import { Boxes, choice, field } from "../page/form_fields";
import { TABLES } from "../words/tables";

const LABELS = TABLES.inputs;
const VERTICAL_UNITS = { "": "as in the file", m: "metres", ft: "feet", "us-ft": "US survey feet" };

/** Inputs with a field of their own, or without one; all others get a field by their type. */
const KNOWN = new Set([
  "tiles", "footprints", "footprintsLayer", "guides", "crs", "verticalUnit", "allowOutsideAreaOfUse", "method", "preset", "lods", "classes",
  "points", "publish", "settings", "title",
]);

/** What the options make of a job. */
export interface Asked {
  process: "reconstruct" | "compare";
  inputs: Record<string, unknown>;
}

export class Options {
  readonly element = el("details", { class: "options" });
  private readonly layer = el("input", { id: "footprints-layer", type: "text", list: "footprints-layers", autocomplete: "off" });
  private readonly layers = el("datalist", { id: "footprints-layers" });
  private readonly layerField = field(LABELS.footprintsLayer, this.layer, "Only where the file has several.");
  private readonly crs = el("input", { id: "crs", type: "text", placeholder: "EPSG:28992", autocomplete: "off", spellcheck: "false" });
  private readonly anywhere = checkbox("anywhere", LABELS.allowOutsideAreaOfUse, "Only if the CRS is right: they are far from where it is used.");
  private readonly verticalUnit = choice("vertical-unit", VERTICAL_UNITS);
  private readonly method = choice("method", {});
  private readonly preset = choice("preset", {});
  private usualPreset = "";
  private readonly others = new Boxes();
  private readonly levels = new Boxes();
  private readonly levelsHint = el("p", { class: "hint", id: "lods-hint" });
  private readonly classes = choice("classes", {});
  private readonly points = checkbox("with-points", LABELS.points, "To see them over the models, with their distances to the roofs. Takes longer.");
  private readonly formats = new Boxes();
  /** The fields of all other inputs, and the value of each that is set. */
  private readonly further = el("div");
  private readonly values = new Map<string, () => string | boolean>();
  private ofComparison = new Set<string>();
  private readonly title = el("input", { id: "title", type: "text", autocomplete: "off", maxlength: 200 });

  /**
   * @param footprints The field for footprints and the row of their file; `guides` likewise.
   * @param onChange Called when a choice may change what is missing.
   */
  constructor(footprints: readonly HTMLElement[], guides: readonly HTMLElement[], onChange: () => void) {
    this.element.append(
      el("summary", {}, "Options"),
      field(LABELS.crs, this.crs, "If the file has none or a wrong one."),
      this.anywhere.element,
      field(LABELS.verticalUnit, this.verticalUnit),
      field(LABELS.method, this.method),
      field(LABELS.preset, this.preset, "Settings that measured better, or those of the method's paper."),
      group("Levels of detail", this.levels, this.levelsHint),
      group("Compare with", this.others),
      field(LABELS.classes, this.classes, "Trusted, only compared with the result, or ignored."),
      ...footprints,
      this.layerField,
      this.layers,
      ...guides,
      this.points.element,
      group(LABELS.publish, this.formats),
      this.further,
      field(LABELS.title, this.title),
    );
    for (const control of [this.method, this.preset, this.levels.element, this.others.element, this.anywhere.box]) {
      control.addEventListener("change", onChange);
    }
    this.crs.addEventListener("input", onChange);
  }

  /** Fill the choices from the processes' own descriptions. */
  async describe(): Promise<void> {
    const { inputs } = await getJson<{ inputs: Record<string, InputDescription> }>("processes/reconstruct");
    for (const [select, name] of [[this.method, "method"], [this.preset, "preset"], [this.classes, "classes"]] as const) {
      const schema = inputs[name]?.schema;
      select.replaceChildren(...(schema?.enum ?? []).map((value) => el("option", { value, selected: value === schema?.default }, value)));
    }
    this.usualPreset = this.preset.value;
    const lods = inputs["lods"]?.schema;
    const level = (value: string): string => `LoD${value}: ${levelWords(value)}`;
    this.levels.offer(labelled(levelsOffered(lods?.enum ?? []), level), levelsOffered([String(lods?.default ?? "")]));
    this.formats.offer(labelled(inputs["publish"]?.schema.items?.enum ?? [], (value) => TABLES.formats[value] ?? value));
    for (const [name, described] of Object.entries(inputs)) if (!KNOWN.has(name)) this.addField(name, described);
    const comparison = await getJson<{ inputs: Record<string, InputDescription> }>("processes/compare");
    this.ofComparison = new Set(Object.keys(comparison.inputs));
    const variants = comparison.inputs["methods"]?.schema.items?.enum ?? [];
    const named = variants.filter((variant) => !variant.endsWith(`:${this.usualPreset}`));
    this.others.offer(labelled(named, (value) => value.replace(":", ", ")));
  }

  /** All methods to run; more than one is a comparison. */
  get variants(): string[] {
    return [...new Set([this.chosen, ...this.others.chosen])];
  }

  /** Whether a level of detail is still to be chosen. */
  get lacksLevel(): boolean {
    return this.variants.length === 1 && !this.levels.isEmpty && this.levels.chosen.length === 0;
  }

  /** Whether tiles that lie far from where their CRS is used are refused. */
  get refusesPlaces(): boolean {
    return this.crs.value.trim() === "" && !this.anywhere.box.checked;
  }

  /** The inputs of the job beside its files. */
  asked(usualTitle: string): Asked {
    const { variants } = this;
    const inputs: Record<string, unknown> = { title: this.title.value.trim() || usualTitle };
    const chosen: [string, string][] = [
      ["crs", this.crs.value.trim()],
      ["footprintsLayer", this.layerField.hidden ? "" : this.layer.value.trim()],
      ["verticalUnit", this.verticalUnit.value],
      ["classes", this.classes.value],
    ];
    if (variants.length > 1) {
      inputs["methods"] = variants;
    } else {
      chosen.push(["method", this.method.value], ["preset", this.preset.value], ["lods", lodsInput(this.levels.chosen)]);
      if (this.points.box.checked) inputs["points"] = true;
      if (this.formats.chosen.length > 0) inputs["publish"] = this.formats.chosen;
    }
    for (const [name, value] of chosen) if (value !== "") inputs[name] = value;
    for (const [name, valueOf] of this.values) {
      const value = valueOf();
      if (value !== "" && value !== false && (variants.length === 1 || this.ofComparison.has(name))) inputs[name] = value;
    }
    if (this.anywhere.box.checked) inputs["allowOutsideAreaOfUse"] = true;
    return { process: variants.length > 1 ? "compare" : "reconstruct", inputs };
  }

  /**
   * Show what goes with the files and with the choices.
   *
   * @param isFar A tile lies far from where its CRS is used.
   * @param layers The layers of the footprints as far as they are known; null without footprints.
   */
  draw(isFar: boolean, layers: readonly string[] | null): void {
    const isComparison = this.variants.length > 1;
    this.anywhere.element.hidden = !isFar;
    if (!isFar) this.anywhere.box.checked = false;
    this.layerField.hidden = layers === null;
    this.layers.replaceChildren(...(layers ?? []).map((value) => el("option", { value })));
    this.levels.disable(() => isComparison);
    this.formats.disable(() => isComparison);
    this.points.box.disabled = isComparison;
    this.levelsHint.textContent = isComparison ? "Comparisons are made at LoD2.2." : "One or several; the records describe the finest.";
    this.others.disable((value) => value === this.chosen);
  }

  /** Forget what was said of the files of the last job. */
  clear(): void {
    this.layer.value = this.title.value = "";
    this.anywhere.box.checked = false;
  }

  /** A field for an input that needs none of its own: a permission, a word of several, or a text. */
  private addField(name: string, { title = name, description = "", schema }: InputDescription): void {
    const id = `option-${name}`;
    if (schema.type === "boolean") {
      const { box, element } = checkbox(id, title, description);
      this.further.append(element);
      this.values.set(name, () => box.checked);
    } else if (schema.enum !== undefined) {
      const words = choice(id, labelled(schema.enum, (word) => word), String(schema.default));
      this.further.append(field(title, words, description));
      this.values.set(name, () => (words.value === schema.default ? "" : words.value));
    } else if (schema.type === "string") {
      const text = el("input", { id, type: "text", autocomplete: "off" });
      this.further.append(field(title, text, description));
      this.values.set(name, () => text.value.trim());
    }
  }

  private get chosen(): string {
    return variantOf(this.method.value, this.preset.value, this.usualPreset);
  }
}

/** A checkbox with a label beside it and a hint below. */
function checkbox(id: string, label: string, hint: string): { box: HTMLInputElement; element: HTMLElement } {
  const box = el("input", { id, type: "checkbox", "aria-describedby": `${id}-hint` });
  return { box, element: el("div", { class: "field" }, el("label", {}, box, ` ${label}`), el("p", { class: "hint", id: `${id}-hint` }, hint)) };
}

function group(title: string, boxes: Boxes, hint?: HTMLElement): HTMLElement {
  return el("fieldset", { class: "field", "aria-describedby": hint?.id }, el("legend", {}, title), boxes.element, hint);
}

function labelled(words: readonly string[], label: (word: string) => string): Record<string, string> {
  return Object.fromEntries(words.map((word) => [word, label(word)]));
}
