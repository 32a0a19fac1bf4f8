import type { Listed } from "../models/batching";
import { classesOf, COLOURING_NAMES, COLOURINGS, CYCLE, type Colouring } from "../models/colouring";
import { colourSwatch, el, swatch } from "../page/elements";
import { announce } from "../page/notices";
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
  private readonly rows = new Map<Category, { row: HTMLElement; box: HTMLInputElement; tally: HTMLElement }>();
  private readonly types = el("div", { class: "legend-rows", role: "group", "aria-label": "Shown roof types" });
  private readonly classes = el("ul", { class: "legend-rows", "aria-label": "Colours", hidden: true });
  private readonly hidden = el("button", { type: "button", class: "quiet", hidden: true });
  private readonly choice = el(
    "select",
    { id: "colouring" },
    ...COLOURING_NAMES.map((name) => el("option", { value: name }, COLOURINGS[name])),
  );
  private counts: ReadonlyMap<Category, number> = new Map();
  private shown: readonly Listed[] = [];

  constructor(
    private readonly onToggle: (category: Category, visible: boolean) => void,
    onColour: (colouring: Colouring) => void,
  ) {
    for (const category of CATEGORY_NAMES) {
      const box = el("input", { type: "checkbox", id: `legend-${category}`, checked: true });
      box.addEventListener("change", () => onToggle(category, box.checked));
      const tally = el("span", { class: "tally" });
      const row = el(
        "label",
        { class: "legend-row", for: box.id },
        box,
        swatch(category),
        el("span", { class: "legend-label" }, CATEGORIES[category].label),
        tally,
      );
      this.rows.set(category, { row, box, tally });
      this.types.append(row);
    }
    this.choice.addEventListener("change", () => {
      onColour(this.colouring);
      this.draw();
      const { colouring } = this;
      announce(colouring === "plain" ? "The roofs have no colours." : `The roofs are coloured by ${COLOURINGS[colouring].toLowerCase()}.`);
    });
    this.hidden.addEventListener("click", () => {
      for (const category of this.unseen()) this.onToggle(category, true);
      this.choice.focus();
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

  /** Set the number of all objects of each category, and the shown objects. */
  set(counts: ReadonlyMap<Category, number>, shown: readonly Listed[]): void {
    this.counts = counts;
    this.shown = shown;
    this.draw();
  }

  private get colouring(): Colouring {
    return this.choice.value as Colouring;
  }

  /** The buildings that are hidden by their type. */
  private unseen(): Category[] {
    const hidden = [...this.rows].filter(([category, { box }]) => !box.checked && (this.counts.get(category) ?? 0) > 0);
    return hidden.map(([category]) => category).filter((category) => category !== "rejected");
  }

  private draw(): void {
    const { colouring } = this;
    this.types.hidden = colouring !== "type";
    this.classes.hidden = colouring === "type";
    for (const [category, { row, tally }] of this.rows) {
      const n = this.counts.get(category) ?? 0;
      tally.textContent = count(n);
      row.hidden = n === 0;
    }
    if (colouring === "type") {
      this.hidden.hidden = true;
      return;
    }
    const row = (...children: HTMLElement[]): HTMLElement => el("li", { class: "legend-row" }, ...children);
    const label = (words: string): HTMLElement => el("span", { class: "legend-label" }, words);
    let lines: HTMLElement[] = [];
    if (colouring === "plane") {
      lines = [row(...CYCLE.map((colour) => colourSwatch(colour)), label("in turn, for the planes of each building"))];
    } else if (colouring !== "plain") {
      lines = classesOf(colouring, this.shown).map((one) =>
        row(colourSwatch(one.colour, one.hatched), label(one.label), el("span", { class: "tally" }, count(one.count))),
      );
    }
    this.classes.replaceChildren(...lines);
    // what is hidden by its type stays hidden, and says so
    const unseen = this.unseen();
    this.hidden.hidden = unseen.length === 0;
    this.hidden.textContent = `Show hidden: ${unseen.map((category) => CATEGORIES[category].label).join(", ")}`;
  }

  /** Check the boxes of the shown categories. */
  check(hidden: ReadonlySet<Category>): void {
    for (const [category, { box }] of this.rows) box.checked = !hidden.has(category);
    this.draw();
  }
}
