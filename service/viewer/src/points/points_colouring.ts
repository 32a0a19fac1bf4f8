/** What the colour of a point shows: the choices, their classes and their colours. */

import { CYCLE, type ColourClass } from "../models/colouring";
import { measure } from "../words/numbers";

export const POINT_COLOURINGS = {
  residual: "Residual",
  plane: "Roof plane",
  class: "Class",
  height: "Elevation",
} as const;

export type PointColouring = keyof typeof POINT_COLOURINGS;

export const POINT_COLOURING_NAMES = Object.keys(POINT_COLOURINGS) as PointColouring[];

/** Colour of points that no model explains. */
export const NONE = "#6b7480";

/** A class of points; classes are numbered as in the shader. */
export interface PointClass extends ColourClass {
  /** Codes of ASPRS; only for the colouring by class. */
  codes?: readonly number[];
}

/**
 * Point minus roof. From blue over grey to orange: distinguishable with every kind of colour blindness. The grey is seen
 * on white paper, on light roofs and in the dark theme.
 */
export const RESIDUALS: readonly PointClass[] = [
  { label: "over 0.5 m below", colour: "#0a4a9c" },
  { label: "to 0.5 m below", colour: "#3b8bd0" },
  { label: "to 0.2 m below", colour: "#94c6ee" },
  { label: "within 0.05 m", colour: "#959d98" },
  { label: "to 0.2 m above", colour: "#f3c26a" },
  { label: "to 0.5 m above", colour: "#e07b10" },
  { label: "over 0.5 m above", colour: "#a83503" },
  { label: "no model", colour: NONE },
];

/** Upper ends of the classes of residuals in mm, all but the last two. */
export const RESIDUAL_ENDS_MM = [-500, -200, -50, 50, 200, 500] as const;

/** The number of a residual in mm among `RESIDUALS`; NaN stands for a point without a model. */
export function residualNumber(residualMm: number): number {
  if (Number.isNaN(residualMm)) return RESIDUALS.length - 1;
  return RESIDUAL_ENDS_MM.filter((end) => residualMm > end).length;
}

const CLASSES: readonly PointClass[] = [
  { label: "Ground", colour: "#b98a4a", codes: [2] },
  { label: "Vegetation", colour: "#009e73", codes: [3, 4, 5] },
  { label: "Building", colour: "#d55e00", codes: [6] },
  { label: "Water", colour: "#56b4e9", codes: [9] },
  { label: "Bridge", colour: "#0072b2", codes: [17] },
  { label: "Noise", colour: "#cc79a7", codes: [7, 18] },
  { label: "Other", colour: "#8d99a6", codes: [] },
];

/** From low to high, as light grows: read in grey, too. */
const RAMP = ["#3e4a89", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"];

/** Most classes of a colouring. */
export const MOST_CLASSES = 9;

const plain = (colour: string): PointClass => ({ label: "", colour });

/** The classes of each colouring, in the shader's order. */
const OF: Record<PointColouring, readonly PointClass[]> = {
  residual: RESIDUALS,
  plane: [...CYCLE.map(plain), plain(NONE)],
  class: CLASSES,
  height: RAMP.map(plain),
};

/** The colours of a colouring, in the same order. */
export const palette = (colouring: PointColouring): string[] => OF[colouring].map(({ colour }) => colour);

/** The number of a class code among the classes. */
export function classNumber(code: number): number {
  const found = CLASSES.findIndex(({ codes }) => codes?.includes(code) === true);
  return found < 0 ? CLASSES.length - 1 : found;
}

/** A line of the legend: one or several colours with their meaning. */
export interface LegendLine {
  colours: readonly string[];
  label: string;
  /** The numbers of its classes; they can be hidden. Empty where nothing can be hidden. */
  numbers: readonly number[];
  /** Points of all levels; null if unknown. */
  count: number | null;
}

/**
 * The legend of a colouring.
 *
 * @param counts Points by class code.
 * @param heights Elevations of the ends of the ramp, in metres.
 */
export function legendLines(
  colouring: PointColouring,
  counts: Readonly<Record<string, number>>,
  [low, high]: readonly [number, number],
): LegendLine[] {
  if (colouring === "height") {
    return [{ colours: RAMP, label: `${measure(low, 0, "m")} to ${measure(high, 0, "m")}`, numbers: [], count: null }];
  }
  if (colouring === "plane") {
    return [
      { colours: CYCLE, label: "planes of each building", numbers: CYCLE.map((_, i) => i), count: null },
      { colours: [NONE], label: "no model", numbers: [CYCLE.length], count: null },
    ];
  }
  const tally = CLASSES.map(() => 0);
  for (const [code, n] of Object.entries(counts)) tally[classNumber(Number(code))] += n;
  const lines = OF[colouring].map(({ label, colour }, i) => ({ colours: [colour], label, numbers: [i], count: colouring === "class" ? tally[i] : null }));
  return lines.filter(({ count }) => count !== 0);
}
