/**
 * The category that an object is drawn in: the roof type of a building, or doubtful, fallback or failed; rejected if it
 * was judged not to be a building.
 *
 * Colours are from the palette of Okabe and Ito (2008), distinguishable with every kind of colour blindness; rarer
 * types have shades of the type that they resemble, as in `pipeline/report/palette.py`. Doubtful, fallback, failed and
 * rejected are shown by hatching and outline, too.
 */
export const CATEGORIES = {
  flat: { label: "Flat", colour: "#56b4e9" },
  pent: { label: "Pent", colour: "#009e73" },
  gable: { label: "Gable", colour: "#e69f00" },
  "half-hip": { label: "Half-hip", colour: "#b3831a" },
  hip: { label: "Hip", colour: "#cc79a7" },
  pyramid: { label: "Pyramid", colour: "#9b4f7d" },
  gambrel: { label: "Gambrel", colour: "#8c5a00" },
  mansard: { label: "Mansard", colour: "#6e3a5a" },
  butterfly: { label: "Butterfly", colour: "#5fc9a8" },
  sawtooth: { label: "Sawtooth", colour: "#00634a" },
  "l-shape": { label: "L-shape", colour: "#8db7e0" },
  "t-shape": { label: "T-shape", colour: "#4f86c6" },
  cross: { label: "Cross", colour: "#1d4f8f" },
  barrel: { label: "Barrel", colour: "#a8a29a" },
  cone: { label: "Cone", colour: "#7d766c" },
  dome: { label: "Dome", colour: "#524c44" },
  combination: { label: "Combination", colour: "#0072b2" },
  unknown: { label: "Other", colour: "#8d99a6" },
  doubtful: { label: "Doubtful model", colour: "#f0e442" },
  fallback: { label: "Fallback block", colour: "#d55e00" },
  failed: { label: "No model", colour: "#c0392b" },
  rejected: { label: "Left out", colour: "#8f6fc0" },
} as const;

export type Category = keyof typeof CATEGORIES;

export const CATEGORY_NAMES = Object.keys(CATEGORIES) as Category[];

/** The category of a record. */
export function categoryOf(status: unknown, roofType: unknown): Category {
  if (status === "failed" || status === "fallback" || status === "doubtful" || status === "rejected") return status;
  return typeof roofType === "string" && roofType in CATEGORIES ? (roofType as Category) : "unknown";
}

/** Whether a category is hatched, as a sign in addition to its colour. */
export function isHatched(category: Category): boolean {
  return category === "fallback" || category === "doubtful" || isFlat(category);
}

/** Whether objects of a category have no model: they lie on the ground as outlines. */
export function isFlat(category: Category): boolean {
  return category === "failed" || category === "rejected";
}
