import { Box3, Ray, Vector3 } from "three";

/** A height field on a square lattice. */
export interface Ground {
  xMin: number;
  yMin: number;
  cellM: number;
  /** Nodes along x and y. */
  nx: number;
  ny: number;
  /** Heights row by row, south to north. */
  heights: Float32Array;
}

interface Level {
  nx: number;
  ny: number;
  sums: Float32Array;
  weights: Float32Array;
}

/**
 * A smooth ground through the floors of the buildings, for the eye only, where a run has no terrain.
 *
 * Known nodes are averaged into ever coarser lattices and unknown ones filled from the next coarser one
 * ("pull-push", Gortler et al. 1996).
 *
 * @param floors x, y and floor height of known places, one after another; at least one.
 * @param box x_min, y_min, x_max, y_max of the lattice.
 * @param cells Approximate number of cells along the longer side.
 */
export function groundThrough(floors: readonly number[], box: readonly number[], cells: number): Ground {
  const [xMin, yMin, xMax, yMax] = box;
  const cellM = Math.max(xMax - xMin, yMax - yMin) / cells || 1;
  const nx = Math.ceil((xMax - xMin) / cellM) + 1;
  const ny = Math.ceil((yMax - yMin) / cellM) + 1;
  const finest = level(nx, ny);
  for (let i = 0; i < floors.length; i += 3) {
    const column = clamp(Math.round((floors[i] - xMin) / cellM), nx);
    const row = clamp(Math.round((floors[i + 1] - yMin) / cellM), ny);
    finest.sums[row * nx + column] += floors[i + 2];
    finest.weights[row * nx + column] += 1;
  }
  const heights = filled(finest);
  return { xMin, yMin, cellM, nx, ny, heights };
}

/** The terrain that a run has written beside its points. */
export interface TerrainFile {
  /** Easting and northing of the first node in metres. */
  origin_m: readonly [number, number];
  spacing_m: number;
  elevation_unit_m: number;
  /** Rows from south to north, nodes from west to east; null where unknown. */
  elevations: readonly (readonly (number | null)[])[];
}

/**
 * The ground of a run, with unknown nodes filled from those around; null if none is known.
 *
 * @param origin Of the scene, in metres.
 */
export function groundOf({ origin_m, spacing_m, elevation_unit_m, elevations }: TerrainFile, origin: readonly [number, number, number]): Ground | null {
  const [nx, ny] = [elevations[0]?.length ?? 0, elevations.length];
  const finest = level(nx, ny);
  for (const [row, nodes] of elevations.entries()) {
    for (const [column, value] of nodes.entries()) {
      if (value === null) continue;
      finest.sums[row * nx + column] = value * elevation_unit_m - origin[2];
      finest.weights[row * nx + column] = 1;
    }
  }
  if (!finest.weights.includes(1)) return null;
  return { xMin: origin_m[0] - origin[0], yMin: origin_m[1] - origin[1], cellM: spacing_m, nx, ny, heights: filled(finest) };
}

function filled(fine: Level): Float32Array {
  const heights = new Float32Array(fine.nx * fine.ny);
  const holes = fine.weights.includes(0);
  const coarse = holes && fine.nx * fine.ny > 1 ? filled(coarser(fine)) : null;
  const width = Math.ceil(fine.nx / 2);
  const depth = Math.ceil(fine.ny / 2);
  for (let row = 0; row < fine.ny; row++) {
    for (let column = 0; column < fine.nx; column++) {
      const at = row * fine.nx + column;
      const known = Math.min(fine.weights[at], 1);
      const guess = coarse === null ? 0 : bilinear(coarse, width, depth, (column - 0.5) / 2, (row - 0.5) / 2);
      const mean = fine.weights[at] > 0 ? fine.sums[at] / fine.weights[at] : 0;
      heights[at] = known * mean + (1 - known) * guess;
    }
  }
  return heights;
}

/** Four cells become one; weights saturate at 1: many near floors do not outvote a far one. */
function coarser(fine: Level): Level {
  const coarse = level(Math.ceil(fine.nx / 2), Math.ceil(fine.ny / 2));
  for (let row = 0; row < fine.ny; row++) {
    for (let column = 0; column < fine.nx; column++) {
      const from = row * fine.nx + column;
      const to = (row >> 1) * coarse.nx + (column >> 1);
      if (fine.weights[from] === 0) continue;
      const weight = Math.min(fine.weights[from], 1);
      coarse.sums[to] += (weight * fine.sums[from]) / fine.weights[from];
      coarse.weights[to] += weight;
    }
  }
  return coarse;
}

function level(nx: number, ny: number): Level {
  return { nx, ny, sums: new Float32Array(nx * ny), weights: new Float32Array(nx * ny) };
}

function bilinear(values: Float32Array, nx: number, ny: number, x: number, y: number): number {
  const [x0, y0] = [clamp(Math.floor(x), nx), clamp(Math.floor(y), ny)];
  const [x1, y1] = [clamp(Math.floor(x) + 1, nx), clamp(Math.floor(y) + 1, ny)];
  const [fx, fy] = [x - Math.floor(x), y - Math.floor(y)];
  const south = values[y0 * nx + x0] * (1 - fx) + values[y0 * nx + x1] * fx;
  const north = values[y1 * nx + x0] * (1 - fx) + values[y1 * nx + x1] * fx;
  return south * (1 - fy) + north * fy;
}

function clamp(value: number, count: number): number {
  return Math.min(Math.max(value, 0), count - 1);
}

/** Height of the ground at a place, between its nodes. */
export function heightAt(ground: Ground, x: number, y: number): number {
  const { xMin, yMin, cellM, nx, ny, heights } = ground;
  return bilinear(heights, nx, ny, (x - xMin) / cellM, (y - yMin) / cellM);
}

/** The box around the ground; level ground has no depth of its own, so a cell is added. */
function boxOf({ xMin, yMin, cellM, nx, ny, heights }: Ground): Box3 {
  const [low, high] = heights.reduce(([least, most], z) => [Math.min(least, z), Math.max(most, z)], [Infinity, -Infinity]);
  return new Box3(new Vector3(xMin, yMin, low - cellM), new Vector3(xMin + cellM * (nx - 1), yMin + cellM * (ny - 1), high + cellM));
}

/** The boxes of the grounds that rays have met. */
const boxes = new WeakMap<Ground, Box3>();

/**
 * Distance at which a ray (unit direction) first meets the ground, infinity if it meets none of it within the lattice or
 * begins below it.
 */
export function groundDistance(ground: Ground, ray: Ray): number {
  const box = boxes.get(ground) ?? boxOf(ground);
  boxes.set(ground, box);
  const entry = box.containsPoint(ray.origin) ? ray.origin : ray.intersectBox(box, new Vector3());
  if (entry === null) return Infinity;
  const enter = entry.distanceTo(ray.origin);
  const beyond = enter + 2 * box.getSize(new Vector3()).length();
  const back = new Ray(ray.at(beyond, new Vector3()), ray.direction.clone().negate());
  const leave = beyond - (back.intersectBox(box, new Vector3())?.distanceTo(back.origin) ?? beyond);
  const place = new Vector3();
  const above = (distance: number): number => {
    const { x, y, z } = ray.at(distance, place);
    return z - heightAt(ground, x, y);
  };
  // within half a cell in plan the ground is almost a plane; a steep ray takes few steps
  const plan = Math.hypot(ray.direction.x, ray.direction.y);
  const step = Math.max((0.5 * ground.cellM) / Math.max(plan, 1e-9), (leave - enter) / MARCH_STEPS);
  if (above(enter) <= 0) return Infinity;
  for (let before = enter; before < leave; before += step) {
    const after = Math.min(before + step, leave);
    if (above(after) <= 0) return crossing(above, before, after);
  }
  return Infinity;
}

const MARCH_STEPS = 2000; // bounds the work of rays along very large lattices
const HALVINGS = 40; // of a step, until floating point has no more digits

/** Where a function falls through zero, between a place where it is positive and one where it is not. */
export function crossing(above: (at: number) => number, positive: number, other: number): number {
  for (let halving = 0; halving < HALVINGS; halving++) {
    const middle = (positive + other) / 2;
    if (above(middle) > 0) positive = middle;
    else other = middle;
  }
  return positive;
}
