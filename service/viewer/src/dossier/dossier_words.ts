/** The sentences of a dossier: what of a model deserves trust, which figures decided, which forms were tried. */

import type { Decision, Feature } from "../api/types";
import { COLUMNS, shown } from "../models/columns";
import { capital, reasonWords } from "../words/fields";
import { counted, measure } from "../words/numbers";

type Properties = Feature["properties"];

/** A row of a table: its texts by the heads of the columns. */
export type Row = Record<string, string>;

/** A figure that says how far the model can be trusted. */
export interface Figure {
  row: Row;
  isGood: boolean;
  /** What it means, in a sentence. */
  words: string;
}

type Limit = { least: number } | { most: number };
type Sentence = (figure: string) => string;

const number = (value: unknown): number | null => (typeof value === "number" && Number.isFinite(value) ? value : null);
const percent = (value: number): string => measure(100 * value, 0, "%");

/** The limits of trust are conventions of this page: the record holds the figures themselves. */
const WITHIN_SHARE = 0.85;
const UNEXPLAINED_SHARE = 0.05;
const HOLE_M = 3;
const RIDGE_SIGMA_M = 0.1;
const RMSE_M = 0.15;
const BIC_MARGIN = 10;
const CONFIDENCE = 0.9;
const FOOTPRINT_SHARE = 0.98;

/** The name of `bic_margin` in both tables. */
const LEAD = "Lead over the next form";

/** The figures that say how far the model can be trusted, those that are known. */
export function trustFigures(properties: Properties): Figure[] {
  const figures: Figure[] = [];
  const add = (column: string, label: string, limit: Limit, good: Sentence, bad: Sentence): void => {
    const value = number(properties[column]);
    if (value === null) return;
    const digits = COLUMNS[column]?.unit === "%" ? 0 : undefined;
    const show = (one: number): string => (column in COLUMNS ? shown(column, one, 1, digits) : measure(one, 1));
    const isGood = "least" in limit ? value >= limit.least : value <= limit.most;
    const words = "least" in limit ? `at least ${show(limit.least)}` : `at most ${show(limit.most)}`;
    const row = { Figure: label, Value: show(value), Limit: words, Meaning: isGood ? "good" : "look twice" };
    figures.push({ row, isGood, words: (isGood ? good : bad)(show(value)) });
  };
  const area = number(properties["footprint_area_m2"]) ?? 0;
  const judged = judgedPoints(properties);
  add("share_within_0_2m", `${capital(judged)} within 0.2 m of the roof`, { least: WITHIN_SHARE },
    (figure) => `${figure} of the ${judged} lie within 0.2 m of the roof.`,
    (figure) => `Only ${figure} of the ${judged} lie within 0.2 m of the roof: its form is not the measured one everywhere.`);
  add("rmse_m", `RMSE of the ${judged}`, { most: RMSE_M },
    (figure) => `The ${judged} differ from the roof by ${figure} (RMSE).`,
    (figure) => `The ${judged} differ from the roof by ${figure} (RMSE): dormers, chimneys or trees are not modelled.`);
  add("unexplained_m2", "Roof without a point near it", { most: Math.max(2, UNEXPLAINED_SHARE * area) },
    (figure) => (figure.startsWith("0.0") ? "Points lie on all of the roof." : `Points lie on nearly all of the roof; ${figure} have none.`),
    (figure) => `${figure} of the roof have no point near them: the form there is assumed.`);
  add("largest_hole_m", COLUMNS["largest_hole_m"].label, { most: HOLE_M },
    (figure) => `The largest hole in the points is ${figure} wide.`,
    (figure) => `The points have a hole ${figure} wide: what is there was not measured.`);
  add("ridge_z_sigma_m", "Uncertainty of the ridge's height", { most: RIDGE_SIGMA_M },
    (figure) => `The height of the ridge is known to ${figure} (one sigma).`,
    (figure) => `The height of the ridge is known to ${figure} only (one sigma).`);
  add("bic_margin", LEAD, { least: BIC_MARGIN },
    (figure) => `No other form that was tried explains the points as well (lead ${figure}).`,
    (figure) => `Another form explains the points almost as well (lead ${figure}): the roof's form is uncertain.`);
  add("detection_confidence", COLUMNS["detection_confidence"].label, { least: CONFIDENCE },
    (figure) => `It is a building with a confidence of ${figure}.`,
    (figure) => `It may not be a building: the confidence is ${figure}.`);
  add("footprint_share", COLUMNS["footprint_share"].label, { least: FOOTPRINT_SHARE },
    (figure) => `The model fills ${figure} of the given footprint.`,
    (figure) => `The model fills only ${figure} of the given footprint: the rest has no points.`);
  return figures;
}

/** The points that the figures of fit are of: older runs did not leave out facades. */
function judgedPoints(properties: Properties): string {
  return number(properties["share_below_roof"]) === null ? "points" : "roof returns";
}

/** How many of all points lie near the roof, and what the record says of the roof returns among them. */
export function withinWords(shareOfAll: number, properties: Properties): string {
  const [within, below] = [number(properties["share_within_0_2m"]), number(properties["share_below_roof"])];
  const all = `${percent(shareOfAll)} of all lie within 0.2 m`;
  if (within === null || below === null || below === 0) return all;
  return `${all}; without the ${percent(below)} on facades and below the roof, ${percent(within)}`;
}

/** What deserves trust and what does not, in sentences. */
export function trust(properties: Properties, decisions: readonly Decision[]): { good: string[]; bad: string[] } {
  const good: string[] = [];
  const bad: string[] = [];
  const { status, reason, valid } = properties;
  const words = typeof reason === "string" ? reasonWords(reason) : "";
  if (status === "failed") bad.push(`There is no model: ${words}.`);
  const detail = typeof properties["reason_detail"] === "string" ? properties["reason_detail"] : "";
  if (status === "doubtful") bad.push(`The model is doubtful: ${[words, detail].filter(Boolean).join(": ")}.`);
  if (status === "fallback") bad.push(`The roof is not modelled, the building is a block: ${words}.`);
  if (valid === true) good.push("The solid is closed and valid by the rules of ISO 19107.");
  for (const figure of trustFigures(properties)) (figure.isGood ? good : bad).push(figure.words);
  const roofType = properties["roof_type"];
  if (roofType === "barrel" || roofType === "cone" || roofType === "dome") good.push(`The roof is one curved surface, a ${roofType}: its faces are facets of it.`);
  else if (properties["is_curved"] === true) bad.push("The roof is curved: planes only approximate it.");
  if (properties["touches_data_edge"] === true) bad.push("It touches the edge of the data: a part of it may be missing.");
  const offset = number(properties["strip_offset_m"]);
  if (offset !== null) bad.push(`Flight strips differed by ${measure(offset, 2, "m")} here; they were aligned first.`);
  const levelled = decisions.find(({ kind, outcome }) => kind === "form" && outcome === "chosen")?.levelled_share ?? 0;
  if (levelled > 0) bad.push(`Faces of ${percent(levelled)} of the plan were made level, since no plane fits the points there.`);
  if (typeof properties["source_id"] === "string") good.push("The outline is the given footprint.");
  else if (status === "ok" || status === "doubtful") {
    const spacing = number(properties["point_spacing_m"]);
    if (spacing !== null) good.push(`The outline is drawn from the points, which are ${measure(spacing, 2, "m")} apart.`);
  }
  if (typeof properties["overridden"] === "string") good.push(`An operator corrected it: ${properties["overridden"]}.`);
  return { good, bad };
}

interface Check {
  label: string;
  show: (value: number) => string;
  /** Whether the limit is the largest allowed value; else it is the least. */
  isMost?: boolean;
  met: string;
  missed: string;
}

const CHECKS: Record<string, Check> = {
  roof_points: { label: "Roof points", show: (v) => counted(v, "point"), met: "enough for a model", missed: "too few for a model without further proof" },
  planes_found: { label: "Planes found in the points", show: (v) => counted(v, "plane"), met: "a roof can be drawn", missed: "no plane was found" },
  points_on_planes_share: { label: "Roof points on a plane", show: percent, met: "the others are dormers, trees or noise", missed: "" },
  point_spacing_m: {
    label: "Distance of neighbouring points",
    show: (v) => measure(v, 2, "m"),
    met: "sparse: simple shapes compete with the arrangement",
    missed: "dense: the arrangement is drawn without competition",
  },
  scatter_m: { label: "Scatter of the points about the roof", show: (v) => measure(v, 2, "m"), isMost: true, met: "like that of a roof", missed: "more than that of a roof: the model is doubtful" },
  share_on_roof: { label: "Points on the roof", show: percent, met: "enough", missed: "too few: the model is doubtful" },
  unseen_share: { label: "Roof without points", show: percent, isMost: true, met: "little", missed: "too much: the model is doubtful" },
  beside_share: { label: "Area without points beside the roof", show: percent, isMost: true, met: "little", missed: "too much: the model is doubtful" },
  returns_per_face: { label: "Points per roof face", show: (v) => measure(v, 1), met: "enough", missed: "too few: the model is doubtful" },
  detection_confidence: { label: "Confidence that it is a building", show: percent, met: "enough", missed: "too low: the model is doubtful" },
  level_side_share: { label: "Outline at which the ground is as high", show: percent, isMost: true, met: "little", missed: "too much: the model is doubtful" },
  above_points_m: { label: "Height of a face above its points", show: (v) => measure(v, 2, "m"), isMost: true, met: "near them", missed: "too high: the model is doubtful" },
  level_on_slope_share: { label: "Points of a level face that lie on a slope", show: percent, isMost: true, met: "few", missed: "too many: the model is doubtful" },
  explained_share: { label: "Roof points that the model explains", show: percent, met: "enough for so few points", missed: "too few: the model is not delivered" },
};

/** The figures that decided which forms were tried, next to their limits. */
export function checkRows(decisions: readonly Decision[]): Row[] {
  return decisions
    .filter(({ kind }) => kind === "check")
    .map(({ name, value, limit, outcome, detail }) => {
      const known = CHECKS[name];
      const show = known?.show ?? ((v: number) => measure(v, 3));
      return {
        Figure: known?.label ?? capital(name.replaceAll("_", " ")),
        Value: value === undefined ? "–" : show(value),
        Limit: limit === undefined || limit === 0 ? "–" : `${known?.isMost ? "up to" : "from"} ${show(limit)}`,
        Meaning: (outcome === "met" ? known?.met : known?.missed) ?? detail,
      };
    });
}

const FORMS: Record<string, string> = {
  arrangement: "Arrangement of the planes' lines",
  templates: "Simple shapes",
  traced: "Traced faces",
  curved: "Facets of a curve",
  primitive: "The method's whole form",
  block: "Level block",
  further: "Further forms",
  guides: "Guides, which were left out",
};

const OUTCOMES: Record<string, string> = {
  chosen: "chosen",
  outdone: "another is better",
  invalid: "not a valid solid",
  undrawable: "cannot be drawn",
  withdrawn: "given up: see below",
};

/** Outcomes of what became of the building. */
export const CHOSEN = ["chosen", "made"];

/** The forms and levels of detail that were tried, in their order: the figures of each by their heads. */
export function formRows(decisions: readonly Decision[], properties: Properties): Row[] {
  const delivered = decisions.filter(({ kind, outcome }) => kind === "form" && outcome === "chosen").at(-1);
  return decisions
    .filter(({ kind }) => kind !== "check")
    .map((entry) => {
      const { kind, name, outcome, detail, validity_codes: codes = [] } = entry;
      const isLevel = kind === "level";
      return {
        Form: isLevel ? `LoD${name}` : (FORMS[name] ?? name),
        Outcome: isLevel && outcome === "chosen" ? "made" : (OUTCOMES[outcome] ?? outcome),
        Faces: String(entry.n_faces ?? "–"),
        Planes: String(entry.n_planes ?? "–"),
        "Points explained": entry.explained_share === undefined ? "–" : percent(entry.explained_share),
        RMSE: entry === delivered ? measure(properties["rmse_m"], 3, "m") : "–",
        [LEAD]: measure(entry.bic_margin, 1),
        Notes: [detail, codes.length > 0 ? `codes ${codes.join(", ")}` : ""].filter(Boolean).join("; "),
      };
    });
}
