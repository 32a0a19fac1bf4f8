/** The options of a new job, as the service describes them. */

import { getJson, variantOf } from "../api/requests";
import type { InputDescription } from "../api/types";
import { el } from "../page/elements";
import { changed, inputFields, type InputFields } from "./input_fields";

type Described = Record<string, InputDescription>;

export class Options {
  readonly element = el("details", { class: "options" }, el("summary", {}, "Options"));
  private fields: InputFields = new Map();
  private ofComparison = new Set<string>();
  private readonly layers = el("datalist", { id: "footprints-layers" });

  /**
   * @param files The fields of the files beside the tiles, with the rows of these files.
   * @param onChange Called when a choice may change what is missing.
   */
  constructor(files: readonly HTMLElement[], onChange: () => void) {
    this.element.append(...files, this.layers);
    this.element.addEventListener("input", onChange);
  }

  /** Make the fields from the processes' own descriptions. */
  async describe(): Promise<void> {
    const read = async (process: string): Promise<Described> => (await getJson<{ inputs: Described }>(`processes/${process}`)).inputs;
    const [one, several] = await Promise.all([read("reconstruct"), read("compare")]);
    this.ofComparison = new Set(Object.keys(several));
    const usual = `:${String(one["preset"]?.schema.default)}`;
    const variants = several["methods"]?.schema.items?.enum?.filter((variant) => !variant.endsWith(usual)) ?? [];
    const methods = { title: "Compare with", description: "Comparisons are made at LoD2.2.", schema: { items: { enum: variants } } };
    this.fields = inputFields({ ...one, methods });
    this.fields.get("footprintsLayer")?.element.querySelector("input")?.setAttribute("list", this.layers.id);
    this.element.append(...[...this.fields.values()].map(({ element }) => element));
  }

  /** All methods to run; more than one is a comparison. */
  get variants(): string[] {
    return [...new Set([this.chosen, ...(this.fields.get("methods")?.boxes?.chosen ?? [])])];
  }

  /** Whether a level of detail is still to be chosen. */
  get lacksLevel(): boolean {
    return this.variants.length === 1 && this.fields.get("lods")?.value() === null;
  }

  /** Whether tiles that lie far from where their CRS is used are refused. */
  get refusesPlaces(): boolean {
    return this.value("crs") === "" && this.value("allowOutsideAreaOfUse") === "";
  }

  /** The process of the job, and its inputs beside its files. */
  asked(usualTitle: string): { process: "reconstruct" | "compare"; inputs: Record<string, unknown> } {
    const { variants } = this;
    const isComparison = variants.length > 1;
    const takes = (name: string): boolean => (isComparison ? this.ofComparison.has(name) : name !== "methods");
    const taken = [...this.fields].filter(([name, { element }]) => !element.hidden && takes(name));
    const inputs = { title: usualTitle, ...changed(taken) };
    return isComparison ? { process: "compare", inputs: { ...inputs, methods: variants } } : { process: "reconstruct", inputs };
  }

  /**
   * Show what goes with the files and with the choices.
   *
   * @param isFar A tile lies far from where its CRS is used.
   * @param layers The layers of the footprints as far as they are known; null without footprints.
   */
  draw(isFar: boolean, layers: readonly string[] | null): void {
    const isOff: Record<string, boolean> = { allowOutsideAreaOfUse: !isFar, footprintsLayer: layers === null, method: false, preset: false };
    const isComparison = this.variants.length > 1;
    for (const [name, { element }] of this.fields) element.hidden = isOff[name] ?? (isComparison && !this.ofComparison.has(name));
    if (!isFar) this.fields.get("allowOutsideAreaOfUse")?.reset();
    this.layers.replaceChildren(...(layers ?? []).map((value) => el("option", { value })));
    this.fields.get("methods")?.boxes?.disable((value) => value === this.chosen);
  }

  /** Forget what was said of the files of the last job. */
  clear(): void {
    for (const name of ["footprintsLayer", "title", "allowOutsideAreaOfUse"]) this.fields.get(name)?.reset();
  }

  private value(name: string): string {
    return String(this.fields.get(name)?.value() ?? "");
  }

  private get chosen(): string {
    return variantOf(this.value("method"), this.value("preset"), String(this.fields.get("preset")?.before));
  }
}
