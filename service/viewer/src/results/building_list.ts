import type { Listed } from "../models/batching";
import { FIGURES, figureWords, type FigureName } from "../models/figures";
import { el, onKeys, swatch } from "../page/elements";
import { count } from "../words/numbers";
import { reasonWords } from "../words/fields";
import { CATEGORIES } from "../words/roof_types";
import "./building_list.css";

const ROW_PX = 50;
const REASON_PX = 18; // a further line of all rows if there is a reason among them
const MORE = 6; // rows beyond the window, so that a small step shows no gap

/**
 * The list of objects as links to their records. Only the rows in the window are in the page: lists may be very long.
 *
 * One row at a time is in the order of the Tab key; the arrow keys, Page Up, Page Down, Home and End lead to the others.
 */
export class BuildingList {
  readonly element: HTMLElement;
  private readonly list = el("ul", { class: "buildings", "aria-label": "Buildings" });
  private readonly empty = el("p", { class: "hint list-empty", hidden: true });
  private readonly drawn = new Map<string, HTMLElement>();
  private objects: readonly Listed[] = [];
  private places = new Map<string, number>();
  private rowPx = ROW_PX;
  private figure: FigureName | null = null;
  private current: string | null = null;
  private scrolled = 0;
  private frame = 0;

  /** @param address The address of an object's record. */
  constructor(private readonly address: (id: string) => string) {
    this.element = el("div", { class: "building-window" }, this.list, this.empty);
    this.element.addEventListener("scroll", () => {
      if (this.element.isConnected) this.scrolled = this.element.scrollTop;
      this.request();
    });
    const page = (): number => Math.floor(this.element.clientHeight / this.rowPx);
    onKeys(this.list, {
      ArrowDown: () => this.step(1),
      ArrowUp: () => this.step(-1),
      PageDown: () => this.step(page()),
      PageUp: () => this.step(-page()),
      Home: () => this.step(-Infinity),
      End: () => this.step(Infinity),
    });
    this.list.addEventListener("focusin", (event) => {
      const id = (event.target as Element).closest<HTMLElement>("li")?.dataset["id"];
      if (id !== undefined) this.mark(id);
    });
    new ResizeObserver(() => this.request()).observe(this.element);
  }

  /**
   * Show these objects in this order.
   *
   * @param figure The one by which they are sorted; it is shown in each row.
   * @param nothing What to say if there are none.
   */
  set(objects: readonly Listed[], figure: FigureName | null, nothing: string): void {
    this.objects = objects;
    this.figure = figure;
    this.places = new Map(objects.map(({ id }, place) => [id, place]));
    this.rowPx = objects.every(({ reason }) => reason === null) ? ROW_PX : ROW_PX + REASON_PX;
    this.list.style.height = `${this.rowPx * objects.length}px`;
    this.list.hidden = objects.length === 0;
    this.empty.hidden = objects.length > 0;
    this.empty.textContent = nothing;
    const focused = this.list.contains(document.activeElement);
    this.list.replaceChildren();
    this.drawn.clear();
    if (this.current === null || !this.places.has(this.current)) this.current = objects[0]?.id ?? null;
    this.draw();
    if (focused) this.focus(this.current);
  }

  /** The neighbour of an object in the list's order, which wraps around; null in an empty list. */
  beside(id: string, step: number): string | null {
    const n = this.objects.length;
    const at = this.places.get(id);
    if (at === undefined) return this.objects[step > 0 ? 0 : n - 1]?.id ?? null;
    return this.objects[(at + step + n) % n]?.id ?? null;
  }

  /** The list is in the page again: bring back its place. */
  returned(): void {
    this.element.scrollTop = this.scrolled;
    this.draw();
  }

  /** Bring an object's row into the window and focus it. */
  focus(id: string | null): void {
    if (id === null || !this.places.has(id)) return;
    this.mark(id);
    this.reveal(id);
    this.drawn.get(id)?.querySelector("a")?.focus({ preventScroll: true });
  }

  // --- drawing

  private request(): void {
    if (this.frame !== 0) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      this.draw();
    });
  }

  /** Put the rows of the window into the page, in their order, and the row that has the focus. */
  private draw(): void {
    const { scrollTop, clientHeight } = this.element;
    const from = Math.max(Math.floor(scrollTop / this.rowPx) - MORE, 0);
    const to = Math.min(Math.ceil((scrollTop + clientHeight) / this.rowPx) + MORE, this.objects.length);
    const wanted = new Set<number>();
    const kept = this.current === null ? undefined : this.places.get(this.current);
    if (kept !== undefined) wanted.add(kept);
    for (let place = from; place < to; place++) wanted.add(place);
    const ids = new Set([...wanted].map((place) => this.objects[place].id));
    for (const [id, row] of this.drawn) {
      if (ids.has(id)) continue;
      row.remove();
      this.drawn.delete(id);
    }
    let next = this.list.firstElementChild;
    for (const place of [...wanted].sort((a, b) => a - b)) {
      const { id } = this.objects[place];
      const row = this.drawn.get(id) ?? this.row(place);
      this.drawn.set(id, row);
      if (row === next) next = next.nextElementSibling;
      else this.list.insertBefore(row, next);
    }
  }

  private row(place: number): HTMLElement {
    const { id, category, reason, reasonDetail, figures } = this.objects[place];
    const usual = [figureWords("height", figures), figureWords("area", figures)].filter((words) => words !== null);
    const extra = this.figure === null || this.figure === "height" || this.figure === "area" ? null : this.figure;
    const link = el(
      "a",
      { class: "building", href: this.address(id), tabindex: id === this.current ? 0 : -1 },
      swatch(category),
      el("span", { class: "building-type" }, CATEGORIES[category].label),
      el("span", { class: "building-figures", title: "Height and footprint" }, usual.join(" · ")),
      el("code", { class: "building-id", title: id }, id),
      extra === null
        ? null
        : el("span", { class: "building-figures", title: FIGURES[extra].label }, figureWords(extra, figures) ?? "–"),
      reason === null
        ? null
        : el("span", { class: "building-reason", title: reasonDetail ?? reasonWords(reason) }, reasonWords(reason)),
    );
    const row = el("li", { "aria-setsize": this.objects.length, "aria-posinset": place + 1 }, link);
    row.dataset["id"] = id;
    row.style.top = `${this.rowPx * place}px`;
    row.style.height = `${this.rowPx}px`;
    return row;
  }

  /** Make a row the one that the Tab key leads to. */
  private mark(id: string): void {
    if (this.current === id) return;
    if (this.current !== null) this.drawn.get(this.current)?.querySelector("a")?.setAttribute("tabindex", "-1");
    this.current = id;
    this.drawn.get(id)?.querySelector("a")?.setAttribute("tabindex", "0");
    this.request();
  }

  private reveal(id: string): void {
    const place = this.places.get(id);
    if (place === undefined) return;
    const { scrollTop, clientHeight } = this.element;
    const [top, bottom] = [this.rowPx * place, this.rowPx * (place + 1)];
    if (top < scrollTop) this.element.scrollTop = top;
    else if (bottom > scrollTop + clientHeight) this.element.scrollTop = bottom - clientHeight;
    this.draw();
  }

  /** Focus the row so many places on, or the one at the end. */
  private step(by: number): void {
    const at = this.current === null ? undefined : this.places.get(this.current);
    if (at === undefined) return;
    this.focus(this.objects[Math.min(Math.max(at + by, 0), this.objects.length - 1)].id);
  }
}

/** `3 712`, or `120 of 3 712`. */
export function tallyWords(shown: number, all: number): string {
  return shown === all ? count(all) : `${count(shown)} of ${count(all)}`;
}
