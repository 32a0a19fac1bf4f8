import type { Listed } from "./batching";
import { el, swatch } from "./elements";
import { count, measure } from "./numbers";
import { reasonWords } from "./record";
import { CATEGORIES, type Category } from "./roof_types";

const STEP = 100;

/** The list of buildings: those with problems first, then the largest. It opens records without a pointer. */
export class BuildingList {
  readonly element: HTMLElement;
  private buildings: Listed[] = [];
  private readonly hidden = new Set<Category>();
  private shown = STEP;
  private readonly list = el("ul", { class: "buildings" });
  private readonly more = el("button", { type: "button", class: "quiet wide" });
  private readonly heading = el("h2", {}, "Buildings");

  constructor(private readonly address: (id: string) => string) {
    this.more.addEventListener("click", () => {
      const first = this.list.children.length;
      this.shown += STEP;
      this.draw();
      this.list.children[first]?.querySelector("a")?.focus();
    });
    this.element = el("div", { class: "list" }, this.heading, this.list, this.more);
  }

  set(buildings: Listed[]): void {
    const weight = { failed: 0, fallback: 1 } as Partial<Record<Category, number>>;
    this.buildings = [...buildings].sort(
      (a, b) =>
        (weight[a.category] ?? 2) - (weight[b.category] ?? 2) || (b.areaM2 ?? 0) - (a.areaM2 ?? 0) || (a.id < b.id ? -1 : 1),
    );
    this.draw();
  }

  show(category: Category, visible: boolean): void {
    if (visible) this.hidden.delete(category);
    else this.hidden.add(category);
    this.draw();
  }

  /** The neighbour of a building in the list's order, which wraps around. */
  beside(id: string, step: number): string | null {
    const visible = this.visible();
    const at = visible.findIndex((building) => building.id === id);
    return visible[(Math.max(at, 0) + step + visible.length) % visible.length]?.id ?? null;
  }

  private visible(): Listed[] {
    return this.buildings.filter(({ category }) => !this.hidden.has(category));
  }

  private draw(): void {
    const visible = this.visible();
    this.heading.replaceChildren("Buildings ", el("span", { class: "tally" }, count(visible.length)));
    this.list.replaceChildren(...visible.slice(0, this.shown).map((building) => el("li", {}, this.row(building))));
    const rest = visible.length - Math.min(this.shown, visible.length);
    this.more.hidden = rest === 0;
    this.more.textContent = `Show ${count(Math.min(rest, STEP))} more of ${count(rest)}`;
  }

  private row({ id, category, reason, heightM, areaM2 }: Listed): HTMLElement {
    const figures = [
      heightM === null ? null : measure(heightM, 1, "m"),
      areaM2 === null ? null : measure(areaM2, 0, "m²"),
    ].filter((figure) => figure !== null);
    return el(
      "a",
      { class: "building", href: this.address(id) },
      swatch(category),
      el("span", { class: "building-type" }, CATEGORIES[category].label),
      el("span", { class: "building-figures", title: "Height and footprint" }, figures.join(" · ")),
      reason === null ? null : el("span", { class: "building-reason" }, reasonWords(reason)),
    );
  }
}
