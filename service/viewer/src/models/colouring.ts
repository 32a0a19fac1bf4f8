/** What the colour of a roof shows: the choices of the view, their classes and their colours. */

import { Color } from "three";
import { reasonWords } from "../words/fields";
import { CATEGORIES, isHatched, type Category } from "../words/roof_types";
import type { Batch, Listed } from "./batching";
import { SURFACE } from "./building_mesh";
import { countOf } from "./selection";

/** A colour with its meaning. */
export interface ColourClass {
  label: string;
  colour: string;
  hatched?: boolean;
}

export const COLOURINGS = {
  type: "Roof type",
  plane: "Roof plane",
  residual: "Residual",
  status: "Status",
  reason: "Reason",
  plain: "None",
} as const;

export type Colouring = keyof typeof COLOURINGS;

const GREY = "#8d99a6";
const PLAIN = "#cbc3b6"; // of roofs below coloured points

/** Colours of things without an order, from the palette of Okabe and Ito (2008); they repeat. */
export const CYCLE = ["#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#0072b2", "#d55e00", "#f0e442"] as const;

/** Share of the roof returns within 0.2 m of the roof, from large to small: a chimney or a mast has few of them. */
const RESIDUALS: readonly (ColourClass & { fromShare: number })[] = [
  { label: "95 % or more within 0.2 m", colour: "#0072b2", fromShare: 0.95 },
  { label: "90 to 95 %", colour: "#56b4e9", fromShare: 0.9 },
  { label: "75 to 90 %", colour: "#f0e442", fromShare: 0.75 },
  { label: "50 to 75 %", colour: "#e69f00", fromShare: 0.5 },
  { label: "under 50 %", colour: "#d55e00", fromShare: 0 },
  { label: "unknown", colour: GREY, fromShare: NaN },
];

const drawn = (category: Category): ColourClass => ({ ...CATEGORIES[category], hatched: isHatched(category) });
const STATUSES: readonly ColourClass[] = [
  { label: "Modelled", colour: CATEGORIES.flat.colour },
  ...(["doubtful", "fallback", "failed"] as const).map(drawn),
];

/** Objects that were judged not to be buildings. */
const LEFT_OUT = drawn("rejected");

const REASON_COLOURS: Record<string, string> = {
  too_few_points: "#56b4e9",
  no_plane: "#e69f00",
  no_partition: "#009e73",
  invalid_solid: "#cc79a7",
  too_complex: "#0072b2",
  no_footprint: "#f0e442",
  height_given: "#882255",
  above_points: "#aa4499",
  level_through_slope: "#117733",
};
const REASONS = new Map(Object.entries(REASON_COLOURS).map(([name, colour]) => [name, { label: reasonWords(name), colour }]));
const NO_REASON: ColourClass = { label: "none: modelled in full", colour: GREY };
const OTHER_REASON: ColourClass = { label: "a fault, a crash, or a limit of time or memory", colour: "#d55e00" };

/** A class with the number of its buildings. */
export type Counted = ColourClass & { count: number };

/** The classes that the buildings have, with the number of each. */
export function classesOf(colouring: "residual" | "status" | "reason", buildings: readonly Listed[]): Counted[] {
  const counts = countOf(buildings.map((one) => classOf(colouring, one)));
  const order: readonly ColourClass[] =
    colouring === "residual" ? RESIDUALS : colouring === "status" ? STATUSES : [NO_REASON, ...REASONS.values(), OTHER_REASON];
  return [...order, LEFT_OUT].flatMap((one) => (counts.has(one) ? [{ ...one, count: counts.get(one) ?? 0 }] : []));
}

function classOf(colouring: "residual" | "status" | "reason", { category, reason, figures: { within } }: Listed): ColourClass {
  if (category === "rejected") return LEFT_OUT;
  switch (colouring) {
    case "residual":
      return RESIDUALS.find(({ fromShare }) => within !== undefined && within >= fromShare) ?? RESIDUALS[RESIDUALS.length - 1];
    case "status":
      return STATUSES[["doubtful", "fallback", "failed"].indexOf(category) + 1];
    case "reason":
      return reason === null ? NO_REASON : (REASONS.get(reason) ?? OTHER_REASON);
  }
}

/** What the colours of roofs show: one of the choices, or a colour for each id; null is that of the type. */
export type RoofColours = Colouring | ((id: string) => string | null);

function colourOf(colouring: Colouring, object: Listed): string {
  if (colouring === "type") return CATEGORIES[object.category].colour;
  if (colouring === "plain") return PLAIN;
  return colouring === "plane" ? GREY : classOf(colouring, object).colour;
}

/** The colour of an object's outline on the map; outlines have no planes, and none but grey are seen without colours. */
export function outlineColour(colouring: Colouring, object: Listed): string {
  return colouring === "plain" ? GREY : colourOf(colouring, object);
}

/** Red, green, blue, opaque for each corner of a batch; in the linear space that three works in. */
export function coloursOf(batch: Batch, shown: RoofColours): Uint8Array {
  const { listed, starts, surfaces } = batch;
  const colours = new Uint8Array(4 * surfaces.length).fill(255);
  const cycle = CYCLE.map(linear);
  listed.forEach((object, n) => {
    const given = typeof shown === "function" ? shown(object.id) : null;
    const roof = linear(given ?? colourOf(typeof shown === "function" ? "type" : shown, object));
    for (let corner = starts[n]; corner < starts[n + 1]; corner++) {
      const surface = surfaces[corner];
      let colour = roof;
      if (surface === SURFACE.wall) colour = WALL;
      else if (surface === SURFACE.ground) colour = FLOOR;
      else if (shown === "plane" && surface >= 0) colour = cycle[surface % cycle.length];
      colours.set(colour, 4 * corner);
    }
  });
  return colours;
}

/** Linear light of a colour, as bytes. */
function linear(colour: string): number[] {
  return new Color(colour).toArray().map((value) => Math.round(255 * value));
}

const [WALL, FLOOR] = [linear("#ece7de"), linear("#b9b3a8")];
