import { COLUMNS, factorOf } from "../models/columns";
import { FIGURE_NAMES, FIGURES, FLAG_NAMES, FLAGS, type FigureName } from "../models/figures";
import { isFiltered, SORTS, STATUSES, unfiltered, type Range, type Sort, type Wanted } from "../models/selection";
import { button, el, setPressed, swatch } from "../page/elements";
import { Tick } from "../page/tick";
import { capital, reasonWords } from "../words/fields";
import { count } from "../words/numbers";
import { CATEGORIES, type Category } from "../words/roof_types";
import { tallyWords } from "./building_list";
import "./filter_panel.css";

/** What the panel shows beside the filters themselves. */
export interface Tallies {
  /** Shown objects, and all objects of the shown categories. */
  shown: number;
  all: number;
  categories: ReadonlyMap<Category, number>;
  reasons: ReadonlyMap<string, number>;
}

const SORT_WORDS: Record<Sort, string> = {
  problems: "Problems first",
  id: "Id",
  roof: "Roof type and status",
  reason: "Reason",
  ...(Object.fromEntries(FIGURE_NAMES.map((name) => [name, FIGURES[name].label])) as Record<FigureName, string>),
};

/** Categories of the two usual choices: what became a building, and what has no model. */
const BUILDINGS: Category[] = [...STATUSES.ok.categories, "doubtful", "fallback", "failed"];
const WITHOUT: Category[] = ["failed", "rejected"];

/** Search, order and filters of the list. */
export class FilterPanel {
  readonly element: HTMLElement;
  private wanted: Wanted | null = null;
  private readonly tally = el("span", { class: "tally" });
  private readonly clear = button("Clear filters", () => this.unfilter(), { class: "quiet" });
  private readonly text = el("input", {
    type: "search",
    id: "list-search",
    "aria-label": "Search ids and reasons",
    placeholder: "Search ids and reasons",
    autocomplete: "off",
    spellcheck: "false",
    oninput: () => this.change({ text: this.text.value }),
  });
  private readonly sort = el(
    "select",
    { "aria-label": "Sort by", onchange: () => this.change({ sort: this.sort.value as Sort }) },
    ...SORTS.map((name) => el("option", { value: name }, SORT_WORDS[name])),
  );
  private readonly direction = button("", () => this.change({ descending: !this.given.descending }), { class: "direction" });
  private readonly buildings = button("", () => this.showOnly(BUILDINGS));
  private readonly without = button("", () => this.showOnly(WITHOUT));
  private readonly summary = el("summary", {}, "Filters");
  private readonly more: HTMLDetailsElement;
  private readonly roofGroup: HTMLElement;
  private readonly categories: Map<Category, Tick>;
  private readonly status: Map<keyof typeof STATUSES, Tick>;
  private readonly reasons = new Map<string, Tick>();
  private readonly reasonBoxes = el("div", { class: "filter-boxes" });
  private readonly reasonGroup = el("fieldset", { class: "filter" }, el("legend", {}, "Reason"), this.reasonBoxes);
  private readonly flags = new Map(FLAG_NAMES.map((name) => [name, new Tick(FLAGS[name], (on) => this.change({ flags: changed(this.given.flags, [name], on) }))]));
  private readonly bounds = new Map(FIGURE_NAMES.map((name) => [name, [this.bound(name, 0), this.bound(name, 1)] as const]));

  constructor(private readonly onChange: (wanted: Wanted) => void) {
    const showing = (label: string, categories: Category[]): Tick =>
      new Tick(label, (on) => this.change({ hidden: changed(this.given.hidden, categories, !on) }), categories.length === 1 ? [swatch(categories[0])] : []);
    this.categories = new Map(STATUSES.ok.categories.map((name) => [name, showing(CATEGORIES[name].label, [name])]));
    const statuses = Object.keys(STATUSES) as (keyof typeof STATUSES)[];
    this.status = new Map(statuses.map((name) => [name, showing(STATUSES[name].label, STATUSES[name].categories)]));
    const group = (title: string, ...boxes: Tick[]): HTMLElement =>
      el("fieldset", { class: "filter" }, el("legend", {}, title), el("div", { class: "filter-boxes" }, ...boxes.map(({ row }) => row)));
    this.roofGroup = group("Roof type", ...this.categories.values());
    this.more = el(
      "details",
      { class: "filters" },
      this.summary,
      el(
        "div",
        { class: "filter-groups" },
        this.reasonGroup,
        group("Status", ...this.status.values()),
        this.roofGroup,
        el("fieldset", { class: "filter" }, el("legend", {}, "Figures"), el("div", { class: "filter-ranges" }, ...FIGURE_NAMES.flatMap((name) => this.range(name)))),
        group("Only", ...this.flags.values()),
      ),
    );
    this.element = el(
      "div",
      { class: "list-head" },
      el("div", { class: "list-title" }, el("h2", {}, "Objects ", this.tally), this.clear),
      el("div", { class: "tool-group choice", role: "group", "aria-label": "Listed objects" }, this.buildings, this.without),
      this.text,
      el("div", { class: "list-order" }, this.sort, this.direction),
      this.more,
    );
  }

  /** Show these filters and numbers; a field that has the focus keeps what is typed. */
  set(wanted: Wanted, { shown, all, categories, reasons }: Tallies): void {
    this.wanted = wanted;
    const { hidden } = wanted;
    this.tally.textContent = tallyWords(shown, all);
    this.clear.hidden = !isFiltered(wanted);
    if (document.activeElement !== this.text) this.text.value = wanted.text;
    this.sort.value = wanted.sort;
    this.direction.textContent = wanted.descending ? "↓" : "↑";
    const order = wanted.descending ? "descending" : "ascending";
    this.direction.setAttribute("aria-label", `Order: ${order}. Turn it around`);
    this.direction.title = capital(order);
    const isShown = (chosen: Category[]): boolean =>
      [...categories.keys()].every((name) => hidden.has(name) !== chosen.includes(name));
    const sum = (chosen: Category[]): number => chosen.reduce((n, name) => n + (categories.get(name) ?? 0), 0);
    for (const [choice, label, chosen] of [[this.buildings, "Buildings", BUILDINGS], [this.without, "Without a model", WITHOUT]] as const) {
      setPressed(choice, isShown(chosen));
      choice.replaceChildren(`${label} `, el("span", { class: "tally" }, count(sum(chosen))));
    }
    for (const [name, box] of this.categories) {
      box.set(!hidden.has(name), categories.get(name) ?? 0);
      box.row.hidden = !categories.has(name);
    }
    this.roofGroup.hidden = STATUSES.ok.categories.every((name) => !categories.has(name));
    for (const [name, box] of this.status) {
      const own = STATUSES[name].categories;
      const off = own.filter((category) => hidden.has(category)).length;
      box.set(off < own.length, sum(own), off > 0 && off < own.length);
    }
    this.setReasons(wanted, reasons);
    for (const [name, box] of this.flags) box.set(wanted.flags.has(name), null);
    for (const [name, fields] of this.bounds) {
      fields.forEach((field, end) => {
        if (document.activeElement !== field) field.value = shownBound(name, wanted.ranges.get(name)?.[end] ?? null);
      });
    }
    const active = wanted.reasons.size + wanted.flags.size + wanted.ranges.size;
    this.summary.textContent = active === 0 ? "Filters" : `Filters (${count(active)} set)`;
  }

  private setReasons(wanted: Wanted, reasons: ReadonlyMap<string, number>): void {
    const known = new Map([...wanted.reasons].map((name) => [name, 0]));
    for (const [name, n] of reasons) known.set(name, n);
    for (const name of known.keys()) {
      if (!this.reasons.has(name)) {
        this.reasons.set(name, new Tick(capital(reasonWords(name)), (on) => this.change({ reasons: changed(this.given.reasons, [name], on) })));
      }
    }
    const order = [...known].sort(([a, m], [b, n]) => n - m || (a < b ? -1 : 1)).map(([name]) => name);
    for (const [name, box] of this.reasons) {
      box.set(wanted.reasons.has(name), known.get(name) ?? 0);
      box.row.hidden = !known.has(name);
    }
    const rows = order.map((name) => this.reasons.get(name)?.row).filter((row) => row !== undefined);
    // a row that is moved would lose the focus
    if (!this.reasonBoxes.contains(document.activeElement)) this.reasonBoxes.replaceChildren(...rows);
    else this.reasonBoxes.append(...rows.filter((row) => !row.isConnected));
    this.reasonGroup.hidden = order.length === 0;
  }

  // --- changes

  private get given(): Wanted {
    if (this.wanted === null) throw new Error("the filters are not set");
    return this.wanted;
  }

  private change(changes: Partial<Wanted>): void {
    this.onChange({ ...this.given, ...changes });
  }

  private unfilter(): void {
    this.onChange(unfiltered(this.given));
    this.text.focus();
  }

  private showOnly(categories: Category[]): void {
    const hidden = new Set((Object.keys(CATEGORIES) as Category[]).filter((name) => !categories.includes(name)));
    if (categories === WITHOUT) this.more.open = true; // the reasons with their numbers
    this.change({ hidden, reasons: new Set() });
  }

  // --- ranges

  private bound(name: FigureName, end: 0 | 1): HTMLInputElement {
    const { label, column } = FIGURES[name];
    const { unit } = COLUMNS[column];
    const field = el("input", {
      type: "number",
      step: "any",
      placeholder: end === 0 ? "from" : "to",
      "aria-label": `${label} ${end === 0 ? "from" : "to"}${unit === "" ? "" : `, ${unit}`}`,
    });
    field.addEventListener("input", () => {
      const bounds: [number | null, number | null] = [...(this.given.ranges.get(name) ?? [null, null])];
      bounds[end] = field.value === "" || field.validity.badInput ? null : storedBound(name, Number(field.value));
      const ranges = new Map<FigureName, Range>(this.given.ranges);
      if (bounds[0] === null && bounds[1] === null) ranges.delete(name);
      else ranges.set(name, bounds);
      this.change({ ranges });
    });
    return field;
  }

  private range(name: FigureName): HTMLElement[] {
    const { label, column } = FIGURES[name];
    const { unit } = COLUMNS[column];
    const words = unit === "" || label.includes(unit) ? label : `${label}, ${unit}`;
    return [el("span", { "aria-hidden": "true" }, words), ...(this.bounds.get(name) ?? [])];
  }
}

/** A set with some members added or removed. */
export function changed<T>(set: ReadonlySet<T>, members: readonly T[], added: boolean): Set<T> {
  const result = new Set(set);
  for (const member of members) {
    if (added) result.add(member);
    else result.delete(member);
  }
  return result;
}

// factors are whole: rounding keeps what was typed, 95 % and not 94.99999

function shownBound(name: FigureName, bound: number | null): string {
  return bound === null ? "" : String(Number((bound * factorOf(FIGURES[name].column)).toPrecision(12)));
}

function storedBound(name: FigureName, shown: number): number {
  return Number((shown / factorOf(FIGURES[name].column)).toPrecision(12));
}
