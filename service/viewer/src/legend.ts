import { el, swatch } from "./elements";
import { count } from "./numbers";
import { CATEGORIES, CATEGORY_NAMES, type Category } from "./roof_types";

/** The colours with their numbers of buildings; a click hides or shows the buildings of one colour. */
export class Legend {
  readonly element = el("div", { class: "legend", role: "group", "aria-label": "Shown roof types" });
  private readonly rows = new Map<Category, { row: HTMLElement; tally: HTMLElement }>();

  constructor(onToggle: (category: Category, visible: boolean) => void) {
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
      this.rows.set(category, { row, tally });
      this.element.append(row);
    }
    this.set(new Map());
  }

  set(counts: ReadonlyMap<Category, number>): void {
    for (const [category, { row, tally }] of this.rows) {
      const n = counts.get(category) ?? 0;
      tally.textContent = count(n);
      row.hidden = n === 0;
    }
  }
}
