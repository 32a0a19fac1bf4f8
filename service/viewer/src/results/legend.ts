import type { Listed } from "../models/batching";
import { classesOf, COLOURINGS, CYCLE, type Colouring } from "../models/colouring";
import { button, colourSwatch, el, swatch } from "../page/elements";
import { choice } from "../page/form_fields";
import { announce } from "../page/notices";
import { Tick } from "../page/tick";
import { count } from "../words/numbers";
import { CATEGORIES, CATEGORY_NAMES, type Category } from "../words/roof_types";
import "./legend.css";

/**
 * The choice of what the roofs' colours show, and the colours with their numbers of buildings.
 *
 * By roof type, a click hides or shows the buildings of one colour.
 */
export class Legend {
  readonly element: HTMLElement;
  private readonly ticks: Map<Category, Tick>;
  private readonly types = el("div", { class: "legend-rows", role: "group", "aria-label": "Shown roof types" });
  private readonly classes = el("ul", { class: "legend-rows", "aria-label": "Colours", hidden: true });
  private readonly hidden = button("", () => this.showAll(), { class: "quiet", hidden: true });
  private readonly choice = choice("colouring", COLOURINGS);
  private counts: ReadonlyMap<Category, number> = new Map();
  private shown: readonly Listed[] = [];

  constructor(
    private readonly onToggle: (category: Category, visible: boolean) => void,
    onColour: (colouring: Colouring) => void,
  ) {
    this.ticks = new Map(CATEGORY_NAMES.map((category) => {
      const tick = new Tick(CATEGORIES[category].label, (on) => onToggle(category, on), [swatch(category)], { class: "legend-row" });
      tick.box.id = `legend-${category}`;
      tick.box.checked = true;
      return [category, tick];
    }));
    this.types.append(...[...this.ticks.values()].map(({ row }) => row));
    this.choice.addEventListener("change", () => {
      onColour(this.colouring);
      this.draw();
      const { colouring } = this;
      announce(colouring === "plain" ? "The roofs have no colours." : `The roofs are coloured by ${COLOURINGS[colouring].toLowerCase()}.`);
    });
    this.element = el(
      "div",
      { class: "legend" },
      el("label", { class: "legend-choice", for: this.choice.id }, "Colour"),
      this.choice,
      this.types,
      this.classes,
      this.hidden,
    );
    this.draw();
  }

  /** Set the number of all objects of each category, the hidden categories, and the shown objects. */
  set(counts: ReadonlyMap<Category, number>, hidden: ReadonlySet<Category>, shown: readonly Listed[]): void {
    this.counts = counts;
    this.shown = shown;
    for (const [category, { box }] of this.ticks) box.checked = !hidden.has(category);
    this.draw();
  }

  private get colouring(): Colouring {
    return this.choice.value as Colouring;
  }

  /** The buildings that are hidden by their type. */
  private unseen(): Category[] {
    const hidden = [...this.ticks].filter(([category, { box }]) => !box.checked && (this.counts.get(category) ?? 0) > 0);
    return hidden.map(([category]) => category).filter((category) => category !== "rejected");
  }

  private showAll(): void {
    for (const category of this.unseen()) this.onToggle(category, true);
    this.choice.focus();
  }

  private draw(): void {
    const { colouring } = this;
    this.types.hidden = colouring !== "type";
    this.classes.hidden = colouring === "type";
    for (const [category, tick] of this.ticks) {
      const n = this.counts.get(category) ?? 0;
      tick.set(tick.box.checked, n);
      tick.row.hidden = n === 0;
    }
    this.classes.replaceChildren(...this.lines(colouring));
    // what is hidden by its type stays hidden, and says so
    const unseen = colouring === "type" ? [] : this.unseen();
    this.hidden.hidden = unseen.length === 0;
    this.hidden.textContent = `Show hidden: ${unseen.map((category) => CATEGORIES[category].label).join(", ")}`;
  }

  /** The colours of what is not chosen by clicks. */
  private lines(colouring: Colouring): HTMLElement[] {
    const row = (...children: HTMLElement[]): HTMLElement => el("li", { class: "legend-row" }, ...children);
    const label = (words: string): HTMLElement => el("span", { class: "legend-label" }, words);
    if (colouring === "type" || colouring === "plain") return [];
    if (colouring === "plane") return [row(...CYCLE.map((colour) => colourSwatch(colour)), label("in turn, for the planes of each building"))];
    return classesOf(colouring, this.shown).map((one) =>
      row(colourSwatch(one.colour, one.hatched), label(one.label), el("span", { class: "tally" }, count(one.count))),
    );
  }
}
