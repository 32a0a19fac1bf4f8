/** What the drawings of a dossier show: edges of the roof, the line of the section, the model and the points along it. */

import { inScene, originInMetres, type SceneFrame } from "../models/building_mesh";
import type { Building, Face } from "../models/cityjson";
import { areaOf, type Point } from "../models/plan";
import { countOf } from "../models/selection";
import { ringNormal, type Normal } from "../models/triangulation";
import { NO_PLANE, NO_RESIDUAL, readNodes, RESIDUAL_SHIFT } from "../points/points_glb";

export type Xyz = readonly [number, number, number];

/** A model in metres around the frame's origin. */
export interface Model {
  vertices: Float64Array;
  faces: Face[];
}

export type EdgeKind = "ridge" | "hip" | "valley" | "step" | "eave";

/** An edge of the roof, in metres. */
export interface RoofEdge {
  kind: EdgeKind;
  from: Xyz;
  to: Xyz;
}

/** A vertical plane through the building: `t` metres along `along` from `at`. */
export interface Section {
  at: Point;
  along: Point;
  /** Words for the caption. */
  through: string;
}

/** A piece of the model in a section. */
export interface Cut {
  kind: Face["kind"];
  from: Point;
  to: Point;
}

/** The points of a building: x, y, z in metres around the frame's origin, with the model's answer to each. */
export interface Points {
  xyz: Float64Array;
  /** Metres above the roof, NaN where there is none. */
  residuals: Float64Array;
  /** Number of the roof plane, -1 for none. */
  planes: Int32Array;
}

const LEVEL = Math.tan((3 * Math.PI) / 180); // an edge that rises less is a ridge, not a hip

export function modelOf(building: Building, frame: SceneFrame): Model {
  return { vertices: inScene(building.vertices, frame), faces: building.faces };
}

function vertex({ vertices }: Model, index: number): Xyz {
  return [vertices[3 * index], vertices[3 * index + 1], vertices[3 * index + 2]];
}

/** Every edge of the roof once: ridges, hips and valleys between two faces, steps and eaves at walls. */
export function roofEdges(model: Model): RoofEdge[] {
  const sides = new Map<string, { from: Xyz; to: Xyz; normals: Normal[] }>();
  const key = (p: Xyz): string => p.map((value) => Math.round(value * 1000)).join();
  for (const { kind, rings } of model.faces) {
    if (kind !== "roof") continue;
    const normal = ringNormal(model.vertices, rings[0] ?? []);
    for (const ring of rings) {
      ring.forEach((index, i) => {
        const from = vertex(model, index);
        const to = vertex(model, ring[(i + 1) % ring.length]);
        const [a, b] = [key(from), key(to)];
        const name = a < b ? `${a} ${b}` : `${b} ${a}`;
        const side = sides.get(name);
        if (side === undefined) sides.set(name, { from, to, normals: [normal] });
        else side.normals.push(normal);
      });
    }
  }
  const edges: RoofEdge[] = [];
  const planKey = (p: Xyz, q: Xyz): string => [key([p[0], p[1], 0]), key([q[0], q[1], 0])].sort().join(" ");
  const alone = [...sides.values()].filter(({ normals }) => normals.length === 1);
  const inPlan = countOf(alone.map(({ from, to }) => planKey(from, to)));
  for (const { from, to, normals } of sides.values()) {
    const [first, second] = normals;
    if (second === undefined) {
      edges.push({ kind: (inPlan.get(planKey(from, to)) ?? 0) > 1 ? "step" : "eave", from, to });
      continue;
    }
    // the first face is to the left of its edge, which runs counter-clockwise
    const left = [-(to[1] - from[1]), to[0] - from[0]];
    const rise = (normal: Normal, side: number): number =>
      normal[2] === 0 ? 0 : (-side * (normal[0] * left[0] + normal[1] * left[1])) / normal[2];
    const bend = rise(first, 1) + rise(second, -1);
    const length = Math.hypot(to[0] - from[0], to[1] - from[1]);
    if (Math.abs(bend) < 1e-6 * Math.max(length, 1)) continue;
    if (bend > 0) edges.push({ kind: "valley", from, to });
    else edges.push({ kind: Math.abs(to[2] - from[2]) <= LEVEL * length ? "ridge" : "hip", from, to });
  }
  return edges;
}

/** Across the middle of the longest ridge; without one down the largest sloping face, or along the building. */
export function sectionOf(model: Model, edges: readonly RoofEdge[]): Section | null {
  const length = ({ from, to }: RoofEdge): number => Math.hypot(to[0] - from[0], to[1] - from[1]);
  const ridge = edges.filter(({ kind }) => kind === "ridge").sort((a, b) => length(b) - length(a) || b.from[2] - a.from[2])[0];
  if (ridge !== undefined && length(ridge) > 0.5) {
    const { from, to } = ridge;
    const along = unit([to[1] - from[1], from[0] - to[0]]);
    return { at: [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2], along: eastward(along), through: "across the longest ridge" };
  }
  const roofs = model.faces.filter(({ kind }) => kind === "roof").map((face) => measured(model, face));
  const largest = roofs.sort((a, b) => b.area - a.area)[0];
  if (largest === undefined) return null;
  const flat = Math.hypot(largest.normal[0], largest.normal[1]) < LEVEL;
  const along = flat ? longestSide(edges) : unit([largest.normal[0], largest.normal[1]]);
  return { at: largest.middle, along: eastward(along), through: flat ? "along the largest face" : "down the largest face" };
}

function measured(model: Model, face: Face): { area: number; normal: Normal; middle: Point } {
  const outer = face.rings[0] ?? [];
  const ring = outer.map((index) => vertex(model, index)).map(([x, y]): Point => [x, y]);
  const mean = (axis: 0 | 1): number => ring.reduce((sum, place) => sum + place[axis], 0) / ring.length;
  return { area: Math.abs(areaOf(ring)), normal: ringNormal(model.vertices, outer), middle: [mean(0), mean(1)] };
}

function longestSide(edges: readonly RoofEdge[]): Point {
  const sides = edges.map(({ from, to }): Point => [to[0] - from[0], to[1] - from[1]]);
  return unit(sides.reduce((longest, side) => (Math.hypot(...side) > Math.hypot(...longest) ? side : longest), [0, 0]));
}

function unit([x, y]: Point): Point {
  const length = Math.hypot(x, y);
  return length === 0 ? [1, 0] : [x / length, y / length];
}

/** So that east, or north, is to the right. */
function eastward([x, y]: Point): Point {
  return x < -1e-9 || (Math.abs(x) <= 1e-9 && y < 0) ? [-x, -y] : [x, y];
}

/** The model where the section cuts it: lines of (t, z). */
export function cutModel(model: Model, { at, along }: Section): Cut[] {
  const cuts: Cut[] = [];
  for (const { kind, rings } of model.faces) {
    const met: [number, number][] = [];
    for (const ring of rings) {
      ring.forEach((index, i) => {
        const p = vertex(model, index);
        const q = vertex(model, ring[(i + 1) % ring.length]);
        const off = (r: Xyz): number => (r[1] - at[1]) * along[0] - (r[0] - at[0]) * along[1];
        const [a, b] = [off(p), off(q)];
        if (a < 0 === b < 0) return;
        const share = a / (a - b);
        const [x, y, z] = [0, 1, 2].map((axis) => p[axis] + share * (q[axis] - p[axis]));
        met.push([(x - at[0]) * along[0] + (y - at[1]) * along[1], z]);
      });
    }
    met.sort((a, b) => a[0] - b[0] || a[1] - b[1]);
    for (let i = 0; i + 1 < met.length; i += 2) cuts.push({ kind, from: met[i], to: met[i + 1] });
  }
  return cuts;
}

/**
 * The points of one building, from all nodes of the binary glTF of the service.
 *
 * @throws Error if the file is damaged or of another kind.
 */
export function pointsIn(file: ArrayBuffer, frame: SceneFrame): Points {
  const { nodes, originM } = readNodes(file);
  const origin = originInMetres(frame);
  const [east, north, up] = originM.map((value, axis) => value - origin[axis]);
  const n = nodes.reduce((sum, { count }) => sum + count, 0);
  const points: Points = { xyz: new Float64Array(3 * n), residuals: new Float64Array(n).fill(NaN), planes: new Int32Array(n).fill(-1) };
  let i = 0;
  for (const { count, places, labels, step, translation } of nodes) {
    for (let k = 0; k < count; k++, i++) {
      const [x, y, z] = translation.map((start, axis) => start + step * places[4 * k + axis]);
      points.xyz.set([x + east, -z + north, y + up], 3 * i);
      if (labels[2 * k] !== NO_PLANE) points.planes[i] = labels[2 * k];
      if (labels[2 * k + 1] !== NO_RESIDUAL) points.residuals[i] = (labels[2 * k + 1] - RESIDUAL_SHIFT) / 1000;
    }
  }
  return points;
}

/** The points of a strip along the section: their indices and (t, z). */
export function strip(points: Points, { at, along }: Section, halfWidthM: number): { index: number; t: number; z: number }[] {
  const found = [];
  for (let index = 0; 3 * index < points.xyz.length; index++) {
    const x = points.xyz[3 * index] - at[0];
    const y = points.xyz[3 * index + 1] - at[1];
    if (Math.abs(y * along[0] - x * along[1]) > halfWidthM) continue;
    found.push({ index, t: x * along[0] + y * along[1], z: points.xyz[3 * index + 2] });
  }
  return found;
}

/** Half the width of a strip that holds enough points to be read, metres. */
export function stripWidth(points: Points, section: Section): number {
  return [0.5, 1, 2].find((halfWidthM) => strip(points, section, halfWidthM).length >= 60) ?? 2;
}

/**
 * The residuals in bins of `binM` metres from `-reachM` upward. Those beyond them (`below`, `above`) and points without a
 * roof (`uncovered`) are counted apart; `total` are those with one.
 */
export function histogram(residuals: Float64Array, binM = 0.05, reachM = 0.6) {
  const counts = new Array<number>(Math.round((2 * reachM) / binM)).fill(0);
  const found = { binM, counts, reachM, below: 0, above: 0, total: 0, uncovered: 0 };
  for (const residual of residuals) {
    if (Number.isNaN(residual)) {
      found.uncovered++;
      continue;
    }
    found.total++;
    const bin = Math.floor((residual + reachM) / binM + 1e-9);
    if (bin < 0) found.below++;
    else if (bin >= counts.length) found.above++;
    else counts[bin]++;
  }
  return found;
}
