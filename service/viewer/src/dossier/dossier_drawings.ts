/** The drawings of a dossier as SVG: plan, section across the ridge, residuals. Lengths are metres, without exaggeration. */

import { CYCLE } from "../models/colouring";
import { boxAround, pathOf, type Point } from "../models/plan";
import { svg } from "../page/elements";
import { NONE, residualNumber, RESIDUALS } from "../points/points_colouring";
import { count, measure } from "../words/numbers";
import {
  cutModel,
  histogram,
  strip,
  type Cut,
  type EdgeKind,
  type Model,
  type Points,
  type RoofEdge,
  type Section,
} from "./dossier_geometry";

export type Colouring = "residual" | "plane";

const WIDTH = 480;
const MARGIN = { left: 40, right: 14, top: 12, bottom: 38 };
const MAX_HEIGHT = 420;
/** More points than this are thinned evenly: a drawing of this size shows no more. */
const MAX_DOTS = 30_000;

interface Frame {
  x: (metres: number) => number;
  y: (metres: number) => number;
  width: number;
  height: number;
  scale: number;
}

/** A frame with the same scale on both axes. */
function frameOf(low: Point, high: Point): Frame {
  const [w, h] = [Math.max(high[0] - low[0], 1), Math.max(high[1] - low[1], 1)];
  const scale = Math.min((WIDTH - MARGIN.left - MARGIN.right) / w, (MAX_HEIGHT - MARGIN.top - MARGIN.bottom) / h);
  const width = w * scale + MARGIN.left + MARGIN.right;
  const height = h * scale + MARGIN.top + MARGIN.bottom;
  return {
    x: (metres) => MARGIN.left + (metres - low[0]) * scale,
    y: (metres) => height - MARGIN.bottom - (metres - low[1]) * scale,
    width,
    height,
    scale,
  };
}

function drawing(frame: Frame, title: string, ...children: SVGElement[]): SVGElement {
  const size = { viewBox: `0 0 ${frame.width.toFixed(1)} ${frame.height.toFixed(1)}`, role: "img", "aria-label": title };
  return svg("svg", { ...size, class: "drawing" }, ...children);
}

/** Dots of one colour each as one path: thousands of elements would be slow. */
function dots(places: Iterable<[number, number, string]>, radius: number): SVGElement {
  const paths = new Map<string, string[]>();
  for (const [x, y, colour] of places) {
    const path = paths.get(colour) ?? [];
    if (path.length === 0) paths.set(colour, path);
    path.push(`M${x.toFixed(1)} ${y.toFixed(1)}h0`);
  }
  const drawn = [...paths].map(([colour, parts]) => svg("path", { d: parts.join(""), stroke: colour }));
  return svg("g", { class: "dots", "stroke-width": (2 * radius).toFixed(1) }, ...drawn);
}

/** The colour of a residual in metres; NaN stands for a point without a roof. */
function residualColour(residualM: number): string {
  return RESIDUALS[residualNumber(1000 * residualM)].colour;
}

/** The colour of a roof plane by its number; -1 stands for none. */
export function planeColour(plane: number): string {
  return plane < 0 ? NONE : CYCLE[plane % CYCLE.length];
}

export function pointColour({ residuals, planes }: Points, index: number, colouring: Colouring): string {
  return colouring === "residual" ? residualColour(residuals[index]) : planeColour(planes[index]);
}

/** A step of 1, 2 or 5 times a power of ten that gives at most so many ticks. */
export function tickStep(range: number, most: number): number {
  const least = Math.max(range / most, 1e-6);
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= least - 1e-9) ?? 10 * power;
}

function ticks(from: number, to: number, step: number): number[] {
  const found = [];
  for (let k = Math.ceil(from / step - 1e-9); k * step <= to + 1e-9; k++) found.push(k * step);
  return found;
}

function line(frame: Frame, name: string, from: Point, to: Point): SVGElement {
  const [x1, y1, x2, y2] = [frame.x(from[0]), frame.y(from[1]), frame.x(to[0]), frame.y(to[1])].map((v) => v.toFixed(1));
  return svg("line", { class: name, x1, y1, x2, y2 });
}

function label(x: number, y: number, text: string, anchor = "middle"): SVGElement {
  return svg("text", { x: x.toFixed(1), y: y.toFixed(1), "text-anchor": anchor }, text);
}

/** Rings as path data, in metres. */
export type Rings = readonly (readonly Point[])[];

/** From above, north up: outline, roof edges, the line of the section, points. */
export function planDrawing(
  outline: Rings,
  edges: readonly RoofEdge[],
  section: Section | null,
  points: Points | null,
  colouring: Colouring,
): SVGElement {
  const corners = [...outline.flat(), ...edges.flatMap(({ from, to }) => [from, to])];
  if (points !== null) for (let i = 0; 3 * i < points.xyz.length; i++) corners.push([points.xyz[3 * i], points.xyz[3 * i + 1]]);
  const [west, south, east, north] = boxAround(corners);
  const low: Point = [west - 1, south - 1];
  const high: Point = [east + 1, north + 1];
  const frame = frameOf(low, high);
  const path = pathOf(outline, ([x, y]) => [frame.x(x), frame.y(y)]);
  const children: SVGElement[] = [svg("path", { class: "outline-fill", d: path, "fill-rule": "evenodd" })];
  if (points !== null) children.push(dots(thinned(points, frame, colouring), dotRadius(points.xyz.length / 3)));
  const order: EdgeKind[] = ["eave", "step", "hip", "valley", "ridge"];
  for (const kind of order) {
    for (const { from, to } of edges.filter((edge) => edge.kind === kind)) {
      children.push(line(frame, `edge edge-${kind}`, [from[0], from[1]], [to[0], to[1]]));
    }
  }
  children.push(svg("path", { class: "outline", d: path }));
  if (section !== null) children.push(...sectionMark(frame, section, low, high));
  children.push(...scaleBar(frame), ...northArrow());
  return drawing(frame, "The building from above, north up", ...children);
}

function* thinned(points: Points, frame: Frame, colouring: Colouring): Iterable<[number, number, string]> {
  const n = points.xyz.length / 3;
  const step = Math.max(1, n / MAX_DOTS);
  for (let k = 0; k < n; k += step) {
    const i = Math.floor(k);
    yield [frame.x(points.xyz[3 * i]), frame.y(points.xyz[3 * i + 1]), pointColour(points, i, colouring)];
  }
}

function dotRadius(n: number): number {
  return n > 8000 ? 0.7 : n > 1500 ? 1 : 1.5;
}

/** The line of the section, as far as the drawing goes, with its ends named. */
function sectionMark(frame: Frame, { at, along }: Section, low: Point, high: Point): SVGElement[] {
  const reach = [-1, 1].map((side) => {
    let far = Infinity;
    for (const axis of [0, 1] as const) {
      const step = side * along[axis];
      if (Math.abs(step) > 1e-9) far = Math.min(far, ((step > 0 ? high[axis] : low[axis]) - at[axis]) / step);
    }
    return side * Math.max(0, far - 0.4);
  });
  const [a, b] = reach.map((t) => [at[0] + t * along[0], at[1] + t * along[1]] as const);
  return [
    line(frame, "section-line", a, b),
    label(frame.x(a[0]) - 6 * along[1], frame.y(a[1]) - 8, "A"),
    label(frame.x(b[0]) - 6 * along[1], frame.y(b[1]) - 8, "B"),
  ];
}

function scaleBar(frame: Frame): SVGElement[] {
  const metres = tickStep((frame.width - MARGIN.left - MARGIN.right) / frame.scale, 4);
  const y = frame.height - 14;
  const x = MARGIN.left;
  const d = `M${x} ${y - 4}v4h${(metres * frame.scale).toFixed(1)}v-4`;
  return [svg("path", { class: "scale-bar", d }), label(x + metres * frame.scale + 8, y, measure(metres, metres < 1 ? 1 : 0, "m"), "start")];
}

function northArrow(): SVGElement[] {
  const [x, y] = [16, 26];
  return [svg("path", { class: "north", d: `M${x} ${y + 14}V${y - 8}M${x - 4} ${y - 1}L${x} ${y - 10}L${x + 4} ${y - 1}` }), label(x, y + 28, "N")];
}

/** The section: the model's profile, the floor at 0 and the points of the strip. */
export function sectionDrawing(
  model: Model,
  section: Section,
  points: Points | null,
  halfWidthM: number,
  colouring: Colouring,
): SVGElement {
  const cuts = cutModel(model, section);
  const near = points === null ? [] : strip(points, section, halfWidthM);
  const places = [...cuts.flatMap(({ from, to }) => [from, to]), ...near.map(({ t, z }): Point => [t, z])];
  const [left, lowest, right, highest] = boxAround(places);
  const low: Point = [left - 1, Math.min(lowest, 0) - 0.5];
  const high: Point = [right + 1, Math.max(highest, 0) + 1];
  const frame = frameOf(low, high);
  const children: SVGElement[] = [];
  for (const t of ticks(0, high[0] - left, tickStep(high[0] - low[0], 10))) {
    children.push(line(frame, "grid", [left + t, low[1]], [left + t, high[1]]), label(frame.x(left + t), frame.height - MARGIN.bottom + 15, measure(t, t % 1 === 0 ? 0 : 1)));
  }
  for (const z of ticks(low[1], high[1], tickStep(high[1] - low[1], 7))) {
    children.push(line(frame, "grid", [low[0], z], [high[0], z]), label(MARGIN.left - 6, frame.y(z) + 4, measure(z, z % 1 === 0 ? 0 : 1), "end"));
  }
  children.push(line(frame, "floor", [low[0], 0], [high[0], 0]));
  const kinds: Cut["kind"][] = ["ground", "wall", "roof"];
  const profile = kinds.flatMap((kind) => cuts.filter((cut) => cut.kind === kind).map(({ from, to }) => line(frame, `cut cut-${kind}`, from, to)));
  const shown = near.filter((_, k) => k % Math.max(1, Math.ceil(near.length / MAX_DOTS)) === 0);
  const radius = Math.max(1.3, dotRadius(near.length * 4));
  const drawnDots = dots(shown.map(({ index, t, z }) => [frame.x(t), frame.y(z), pointColour(points as Points, index, colouring)]), radius);
  children.push(...profile, drawnDots);
  children.push(label(MARGIN.left + 8, MARGIN.top + 10, "A"), label(frame.width - MARGIN.right - 8, MARGIN.top + 10, "B"));
  children.push(label(frame.width / 2, frame.height - 4, "metres along the line; heights in metres above the floor"));
  return drawing(frame, "A section through the building", ...children);
}

/** The residuals of the points in bins of 5 cm. */
export function histogramDrawing(residuals: Float64Array): SVGElement {
  const found = histogram(residuals);
  const height = 180;
  const [left, right, base] = [52, WIDTH - 14, height - 40];
  const most = Math.max(1, ...found.counts);
  const x = (value: number): number => left + ((value + found.reachM) / (2 * found.reachM)) * (right - left);
  const y = (value: number): number => base - (value / most) * (base - 14);
  const children: SVGElement[] = [];
  for (const tick of ticks(0, most, tickStep(most, 4))) {
    children.push(svg("line", { class: "grid", x1: left, x2: right, y1: y(tick).toFixed(1), y2: y(tick).toFixed(1) }), label(left - 6, y(tick) + 4, count(tick), "end"));
  }
  found.counts.forEach((value, k) => {
    const from = -found.reachM + k * found.binM;
    const colour = residualColour(from + found.binM / 2);
    const width = Math.max(1, x(from + found.binM) - x(from) - 1);
    children.push(svg("rect", { x: x(from).toFixed(1), y: y(value).toFixed(1), width: width.toFixed(1), height: (base - y(value)).toFixed(1), fill: colour }));
  });
  for (const limit of [-0.2, 0.2]) children.push(svg("line", { class: "limit", x1: x(limit), x2: x(limit), y1: 10, y2: base }));
  for (const tick of ticks(-found.reachM, found.reachM, 0.2)) children.push(label(x(tick), base + 15, measure(tick, 1)));
  children.push(label((left + right) / 2, height - 6, "metres below and above the roof; the lines are at 0.2 m"));
  return svg("svg", { viewBox: `0 0 ${WIDTH} ${height}`, class: "drawing", role: "img", "aria-label": "Residuals of the points" }, ...children);
}
