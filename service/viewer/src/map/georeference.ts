/** From the plane of the map to Web Mercator and back, fitted to places that are known in both. */

import type { Feature } from "../api/types";
import { areaOf, boxAround, polygonsOf, type Point } from "../models/plan";

/** A place in metres around the scene's origin, and in Web Mercator: 0 to 1 from west to east and from north to south. */
export interface Pair {
  plane: Point;
  mercator: Point;
}

export interface Georeference {
  toMercator: (place: Point) => Point;
  toPlane: (place: Point) => Point;
  /** Largest distance in metres between a place and where the fit puts it. */
  errorM: number;
}

const CURVED_M = 400; // below this extent a plane bends by less than 4 cm: three terms are enough

/** Longitude and latitude in degrees as a place in Web Mercator. */
export function mercatorOf([longitude, latitude]: readonly number[]): Point {
  const sine = Math.sin((latitude * Math.PI) / 180);
  return [longitude / 360 + 0.5, 0.5 - Math.atanh(sine) / (2 * Math.PI)];
}

/**
 * The corners of outlines that are given twice: in the coordinates of the tiles and in degrees.
 *
 * @param inPlane From the coordinates of the tiles to the plane of the map.
 */
export function pairsOf(native: readonly Feature[], degrees: readonly Feature[], inPlane: (place: Point) => Point): Pair[] {
  const others = new Map(degrees.map((feature) => [feature.id, feature]));
  return native.flatMap((feature) => {
    const [mine, theirs] = [outerRing(feature), outerRing(others.get(feature.id))];
    if (mine.length < 3 || mine.length !== theirs.length) return [];
    // the service turns rings of degrees around if RFC 7946 wants that; the first corner stays the first
    const same = areaOf(mine) > 0 === areaOf(theirs) > 0;
    const matching = same ? theirs : [theirs[0], ...theirs.slice(1).reverse()];
    return mine.map((place, i) => ({ plane: inPlane(place), mercator: mercatorOf(matching[i]) }));
  });
}

/** The outer ring of an outline of one part, not closed; empty for any other: the order of several parts may differ. */
function outerRing(feature: Feature | undefined): readonly Point[] {
  const [polygon, ...others] = polygonsOf(feature?.geometry);
  return polygon === undefined || others.length > 0 ? [] : polygon[0].slice(0, -1);
}

/** Fit both directions; null if there are too few places, or all on one line. */
export function georeference(pairs: readonly Pair[]): Georeference | null {
  const plane = pairs.map((pair) => pair.plane);
  const mercator = pairs.map((pair) => pair.mercator);
  const toMercator = fitted(plane, mercator, extentOf(plane) > CURVED_M);
  const toPlane = fitted(mercator, plane, extentOf(plane) > CURVED_M);
  if (toMercator === null || toPlane === null) return null;
  const errors = pairs.map((pair) => {
    const [x, y] = toPlane(pair.mercator);
    return Math.hypot(x - pair.plane[0], y - pair.plane[1]);
  });
  return { toMercator, toPlane, errorM: errors.reduce((a, b) => Math.max(a, b), 0) };
}

function extentOf(places: readonly Point[]): number {
  const [west, south, east, north] = boxAround(places);
  return Math.max(east - west, north - south);
}

/** The polynomial of the first or second order that takes places to others with the least squares; null if there is none. */
function fitted(from: readonly Point[], to: readonly Point[], curved: boolean): ((place: Point) => Point) | null {
  if (from.length < 3) return null;
  // around the middle and in a unit of the extent: the squares would lose digits otherwise
  const middle: Point = [mean(from, 0), mean(from, 1)];
  const unit = Math.max(extentOf(from), Number.MIN_VALUE);
  const target: Point = [mean(to, 0), mean(to, 1)];
  const terms = ([x, y]: Point): number[] => {
    const [u, v] = [(x - middle[0]) / unit, (y - middle[1]) / unit];
    return curved ? [1, u, v, u * u, u * v, v * v] : [1, u, v];
  };
  const rows = from.map(terms);
  const sums = rows[0].map((_, i) => {
    const left = rows[0].map((__, j) => sum(rows.map((row) => row[i] * row[j])));
    const right = ([0, 1] as const).map((axis) => sum(rows.map((row, k) => row[i] * (to[k][axis] - target[axis]))));
    return [...left, ...right];
  });
  const factors = solved(sums);
  if (factors === null) return null;
  return (place) => {
    const found = terms(place);
    const shifted = (axis: 0 | 1): number => target[axis] + sum(found.map((term, i) => term * factors[i][axis]));
    return [shifted(0), shifted(1)];
  };
}

const sum = (values: readonly number[]): number => values.reduce((a, b) => a + b, 0);

const mean = (places: readonly Point[], axis: 0 | 1): number => sum(places.map((place) => place[axis])) / places.length;

/** Gaussian elimination with pivots, of a square matrix beside its right sides; null if it is singular. */
function solved(rows: number[][]): number[][] | null {
  const n = rows.length;
  const largest = Math.max(...rows.flatMap((row) => row.slice(0, n)).map(Math.abs));
  for (let column = 0; column < n; column++) {
    let pivot = column;
    for (let row = column + 1; row < n; row++) if (Math.abs(rows[row][column]) > Math.abs(rows[pivot][column])) pivot = row;
    if (Math.abs(rows[pivot][column]) < 1e-10 * largest) return null;
    [rows[column], rows[pivot]] = [rows[pivot], rows[column]];
    for (const row of rows) {
      if (row === rows[column]) continue;
      const factor = row[column] / rows[column][column];
      row.forEach((_, k) => (row[k] -= factor * rows[column][k]));
    }
  }
  return rows.map((row, i) => row.slice(n).map((value) => value / row[i]));
}
