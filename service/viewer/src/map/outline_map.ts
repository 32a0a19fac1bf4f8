/** The outlines in plan, north up, drawn on a canvas. It is independent of the service, of lists and of the 3D view. */

import { MathUtils } from "three";
import type { Outline } from "../models/outlines";
import { boxAround, united, type Box } from "../models/plan";
import { el, onKeys } from "../page/elements";
import { CATEGORIES, CATEGORY_NAMES, isFlat, type Category } from "../words/roof_types";
import { MapView, scaleBar } from "./map_view";
import "./outline_map.css";

const CELLS = 24; // paths per side of the map: those out of sight are not drawn
const FLIGHT_MS = 350;
const CLICK_PX = 5; // farther is a drag
const NEAR_PX = 6; // a click this near to a small outline means it
const STEP_PX = 80; // of an arrow key
const DASHED_PX_PER_M = 1.5; // farther out dashes are as long as the outlines
const SELECTED_ROOM = 5; // times the size of a selected object

/** What lies beneath the outlines. */
export interface Backdrop {
  draw(context: CanvasRenderingContext2D, view: MapView): void;
}

interface Shape extends Outline {
  box: Box;
}

/** The colour of an object. */
type ColourOf = (shape: { id: string; category: Category }) => string;

interface Cell {
  category: Category;
  colour: string;
  path: Path2D;
  box: Box;
}

export class OutlineMap {
  readonly element: HTMLElement;
  private readonly canvas = el("canvas", {
    class: "map-canvas",
    tabindex: 0,
    role: "img",
    "aria-label":
      "The outlines as a map, north up. Arrow keys move, plus and minus zoom, f shows all. The list beside it leads to every record.",
  });
  private readonly bar = el("div", { class: "map-scale" });
  private readonly credit = el("div", { class: "map-credit", hidden: true });
  private readonly context = this.canvas.getContext("2d");
  private readonly shapes = new Map<string, Shape>();
  private only: ReadonlySet<string> | null = null;
  private colours: ColourOf = ({ category }) => CATEGORIES[category].colour;
  private selected: string | null = null;
  private cells: Cell[] | null = null;
  private readonly view = new MapView();
  private readonly watch: ResizeObserver;
  private readonly dark = matchMedia("(prefers-color-scheme: dark)");
  private readonly still = matchMedia("(prefers-reduced-motion: reduce)");
  private backdrop: Backdrop | null = null;
  private flight: { from: number; start: MapView; end: MapView } | null = null;
  private frame = 0;
  private touched = false;
  private readonly pointers = new Map<number, { x: number; y: number }>();
  private pressedAt: { x: number; y: number; alone: boolean } | null = null;

  /** @param onPick Gets the object that was clicked, null for a click beside all of them. */
  constructor(private readonly onPick: (id: string | null) => void) {
    this.element = el("div", { class: "map" }, this.canvas, this.bar, this.credit);
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => this.pressed(event));
    canvas.addEventListener("pointermove", (event) => this.moved(event));
    canvas.addEventListener("pointerup", (event) => this.released(event));
    canvas.addEventListener("pointercancel", (event) => this.released(event));
    canvas.addEventListener("wheel", (event) => this.wheeled(event), { passive: false });
    onKeys(canvas, {
      ArrowLeft: () => this.pan(STEP_PX, 0),
      ArrowRight: () => this.pan(-STEP_PX, 0),
      ArrowUp: () => this.pan(0, STEP_PX),
      ArrowDown: () => this.pan(0, -STEP_PX),
      "+": () => this.zoom(1.4),
      "=": () => this.zoom(1.4),
      "-": () => this.zoom(1 / 1.4),
      f: () => this.fit(),
      Escape: () => onPick(null),
    });
    this.dark.addEventListener("change", this.request);
    this.watch = new ResizeObserver(() => this.resize());
    this.watch.observe(this.element);
  }

  /** Add outlines; until the user moves the map it keeps showing all of them. */
  add(outlines: readonly Outline[]): void {
    for (const one of outlines) if (one.rings.length > 0) this.shapes.set(one.id, { ...one, box: boxOf(one.rings) });
    this.cells = null;
    if (!this.touched) this.fit(false);
    this.request();
  }

  /** Colour the objects from now on by a function of their ids and categories. */
  colourBy(colours: ColourOf): void {
    this.colours = colours;
    this.cells = null;
    this.request();
  }

  /** Show these objects and hide all others; null shows all. */
  showOnly(ids: ReadonlySet<string> | null): void {
    this.only = ids;
    this.cells = null;
    this.request();
  }

  /** Mark an object, or none; `fly` brings it into view. */
  select(id: string | null, fly: boolean): void {
    this.selected = id;
    const shape = id === null ? undefined : this.shapes.get(id);
    if (shape !== undefined && fly) {
      this.touched = true;
      this.flyTo(this.view.around(shape.box, SELECTED_ROOM, 8));
    }
    this.request();
  }

  /** See everything that is shown. */
  fit(animated = true): void {
    const boxes = this.shown().map(({ box }) => box);
    const all = boxes.length > 0 ? boxes : [...this.shapes.values()].map(({ box }) => box);
    if (all.length > 0) this.flyTo(this.view.around(united(all), 1.08, 30), animated);
  }

  /** Draw something beneath the outlines; its owners are credited. */
  lay(backdrop: Backdrop, credit: string): void {
    this.backdrop = backdrop;
    this.credit.textContent = credit;
    this.credit.hidden = false;
    this.request();
  }

  /** Release all resources. */
  dispose(): void {
    cancelAnimationFrame(this.frame);
    this.frame = -1;
    this.watch.disconnect();
    this.dark.removeEventListener("change", this.request);
    this.element.remove();
  }

  // --- drawing

  /** Draw once, with the browser's next frame. */
  readonly request = (): void => {
    if (this.frame === 0) this.frame = requestAnimationFrame((now) => this.draw(now));
  };

  private resize(): void {
    const [width, height] = [this.element.clientWidth, this.element.clientHeight];
    if (width === 0 || height === 0) return;
    const ratio = Math.min(devicePixelRatio, 2);
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    Object.assign(this.view, { width, height });
    if (this.touched) this.request();
    else this.fit(false);
  }

  private shown(): Shape[] {
    const shapes = [...this.shapes.values()];
    const { only } = this;
    return only === null ? shapes : shapes.filter(({ id }) => only.has(id));
  }

  private draw(now: number): void {
    this.frame = 0;
    const { context, view } = this;
    // until the observer of its size has seen it
    if (context === null || view.width === 0 || !this.element.isConnected) return;
    this.fly(now);
    const began = performance.now();
    const ratio = this.canvas.width / Math.max(view.width, 1);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, view.width, view.height);
    this.backdrop?.draw(context, view);
    const [a, , , d, e, f] = view.matrix();
    context.setTransform(ratio * a, 0, 0, ratio * d, ratio * e, ratio * f);
    const seen = view.box();
    this.cells ??= cellsOf(this.shown(), this.colours);
    for (const cell of this.cells) if (meet(cell.box, seen)) this.paint(context, cell);
    const shape = this.selected === null ? undefined : this.shapes.get(this.selected);
    if (shape !== undefined) this.mark(context, shape);
    this.drawBar();
    Object.assign(this.canvas.dataset, { outlines: this.shown().length, frameMs: (performance.now() - began).toFixed(1) });
    if (this.flight !== null) this.request();
  }

  private paint(context: CanvasRenderingContext2D, { path, category, colour }: Cell): void {
    const { view } = this;
    const pixel = 1 / view.scale;
    context.fillStyle = context.strokeStyle = colour;
    context.globalAlpha = isFlat(category) ? 0.3 : 0.55;
    context.fill(path);
    context.globalAlpha = 1;
    context.lineWidth = (isFlat(category) ? 1.8 : 1.2) * pixel;
    const dashes = view.scale > DASHED_PX_PER_M ? DASHES[category] : undefined;
    context.setLineDash(dashes?.map((length) => length * pixel) ?? []);
    context.stroke(path);
  }

  private mark(context: CanvasRenderingContext2D, shape: Shape): void {
    const { view } = this;
    const path = traced(shape.rings);
    context.fillStyle = this.colours(shape);
    context.globalAlpha = 0.7;
    context.fill(path);
    context.globalAlpha = 1;
    context.setLineDash([]);
    const styles = getComputedStyle(this.canvas);
    // a rim in the colour of the paper keeps the mark apart from whatever it touches
    for (const [name, width] of [["--paper", 6], ["--accent", 3.2]] as const) {
      context.strokeStyle = styles.getPropertyValue(name);
      context.lineWidth = width / view.scale;
      context.stroke(path);
    }
  }

  private drawBar(): void {
    const { metres, pixels } = scaleBar(this.view.scale);
    this.bar.textContent = metres >= 1000 ? `${metres / 1000}\u202fkm` : `${metres}\u202fm`;
    this.bar.style.width = `${pixels}px`;
  }

  // --- moving

  private flyTo(end: MapView, animated = true): void {
    if (!animated || this.still.matches || this.view.width === 0) {
      this.flight = null;
      this.view.become(end);
    } else {
      this.flight = { from: performance.now(), start: this.view.copy(), end };
    }
    this.request();
  }

  private fly(now: number): void {
    if (this.flight === null) return;
    const { from, start, end } = this.flight;
    const eased = MathUtils.smoothstep(now, from, from + FLIGHT_MS);
    this.view.between(start, end, eased);
    if (eased === 1) this.flight = null;
  }

  private zoom(factor: number, x = this.view.width / 2, y = this.view.height / 2): void {
    this.flight = null;
    this.touched = true;
    this.view.zoom(factor, x, y);
    this.request();
  }

  private pan(dx: number, dy: number): void {
    this.flight = null;
    this.touched = true;
    this.view.pan(dx, dy);
    this.request();
  }

  // --- pointers and keys

  private inView({ clientX, clientY }: MouseEvent): { x: number; y: number } {
    const { left, top } = this.canvas.getBoundingClientRect();
    return { x: clientX - left, y: clientY - top };
  }

  private pressed(event: PointerEvent): void {
    const place = this.inView(event);
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, place);
    this.pressedAt = { ...place, alone: this.pointers.size === 1 && event.button === 0 };
  }

  private moved(event: PointerEvent): void {
    const place = this.inView(event);
    const before = this.pointers.get(event.pointerId);
    if (before === undefined) {
      this.canvas.classList.toggle("pointing", this.under(place) !== null);
      return;
    }
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    this.pointers.set(event.pointerId, place);
    if (other === undefined) {
      this.pan(place.x - before.x, place.y - before.y);
      return;
    }
    // two fingers: their middle moves the map, their distance zooms it
    this.pan((place.x - before.x) / 2, (place.y - before.y) / 2);
    const spread = Math.hypot(before.x - other.x, before.y - other.y);
    const factor = Math.hypot(place.x - other.x, place.y - other.y) / Math.max(spread, 1);
    this.zoom(factor, (place.x + other.x) / 2, (place.y + other.y) / 2);
  }

  private released(event: PointerEvent): void {
    this.pointers.delete(event.pointerId);
    const { pressedAt } = this;
    const place = this.inView(event);
    if (event.type !== "pointerup" || pressedAt?.alone !== true) return;
    if (Math.hypot(place.x - pressedAt.x, place.y - pressedAt.y) <= CLICK_PX) this.onPick(this.under(place));
  }

  private wheeled(event: WheelEvent): void {
    event.preventDefault();
    const { x, y } = this.inView(event);
    const pixels = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY : event.deltaY * 30;
    this.zoom(Math.exp(-0.0018 * Math.min(Math.max(pixels, -400), 400)), x, y);
  }

  /** The smallest object at a place of the map; a very small one also takes what is near it. */
  private under({ x, y }: { x: number; y: number }): string | null {
    const [east, north] = this.view.place(x, y);
    const near = NEAR_PX / this.view.scale;
    const ratio = this.canvas.width / Math.max(this.view.width, 1);
    let best: { id: string; size: number } | null = null;
    for (const { id, rings, box } of this.shown()) {
      if (!meet(box, [east - near, north - near, east + near, north + near])) continue;
      const size = (box[2] - box[0]) * (box[3] - box[1]);
      if (size >= (best?.size ?? Infinity)) continue;
      const isSmall = Math.max(box[2] - box[0], box[3] - box[1]) < 2 * near;
      if (isSmall || this.context?.isPointInPath(traced(rings), x * ratio, y * ratio, "evenodd") === true) best = { id, size };
    }
    return best?.id ?? null;
  }
}

const DASHES: Partial<Record<Category, number[]>> = { doubtful: [10, 2], fallback: [7, 3], failed: [4, 3], rejected: [1.5, 2.5] };

/** The outlines of each category as paths of neighbours. */
function cellsOf(shapes: readonly Shape[], colours: ColourOf): Cell[] {
  if (shapes.length === 0) return [];
  const [x0, y0, x1, y1] = united(shapes.map(({ box }) => box));
  const side = Math.max(x1 - x0, y1 - y0, 1) / CELLS;
  const found = new Map<string, Cell>();
  for (const shape of shapes) {
    const { category, rings, box } = shape;
    const colour = colours(shape);
    const key = `${category} ${colour} ${Math.floor((box[0] - x0) / side)} ${Math.floor((box[1] - y0) / side)}`;
    const cell = found.get(key) ?? { category, colour, path: new Path2D(), box };
    cell.box = united([cell.box, box]);
    traced(rings, cell.path);
    found.set(key, cell);
  }
  const order = (category: Category): number => CATEGORY_NAMES.indexOf(category);
  return [...found.values()].sort((a, b) => order(a.category) - order(b.category));
}

function traced(rings: readonly Float32Array[], path = new Path2D()): Path2D {
  for (const ring of rings) {
    for (let i = 0; i < ring.length; i += 2) {
      if (i === 0) path.moveTo(ring[0], ring[1]);
      else path.lineTo(ring[i], ring[i + 1]);
    }
    path.closePath();
  }
  return path;
}

function boxOf(rings: readonly Float32Array[]): Box {
  return boxAround(rings.flatMap((ring) => Array.from({ length: ring.length / 2 }, (_, i) => [ring[2 * i], ring[2 * i + 1]])));
}

function meet(a: Box, b: Box): boolean {
  return a[0] <= b[2] && b[0] <= a[2] && a[1] <= b[3] && b[1] <= a[3];
}
