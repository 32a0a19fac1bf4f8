/** The figures and marks of a record by which the list is sorted and filtered. */

import { COLUMNS, shown } from "./columns";

interface Figure {
  label: string;
  /** The column of the record, and that of a rejected object if it has another name. */
  column: string;
  ofRejected?: string;
  /** Decimals; those of the column if none are given. */
  digits?: number;
}

const labelOf = (column: string): string => COLUMNS[column]?.label ?? column;

export const FIGURES = {
  height: { label: "Height", column: "height_m", digits: 1 },
  area: { label: "Area", column: "footprint_area_m2", ofRejected: "area_m2", digits: 0 },
  within: { label: labelOf("share_within_0_2m"), column: "share_within_0_2m" },
  residual: { label: "Residual (RMSE)", column: "rmse_m" },
  planes: { label: "Roof faces", column: "n_planes" },
  confidence: { label: "Confidence", column: "detection_confidence" },
  volume: { label: labelOf("volume_m3"), column: "volume_m3" },
  points: { label: labelOf("n_points"), column: "n_points" },
  density: { label: "Points per m²", column: "density_per_m2" },
  coverage: { label: labelOf("coverage"), column: "coverage" },
} as const satisfies Record<string, Figure>;

export type FigureName = keyof typeof FIGURES;

export const FIGURE_NAMES = Object.keys(FIGURES) as FigureName[];

export type Figures = Partial<Record<FigureName, number>>;

/** Marks that a building may have. */
export const FLAGS = {
  edge: "At the edge of the data",
  curved: "Curved roof",
  overridden: "Changed by an override",
  faults: "Own solid had faults",
} as const;

export type Flag = keyof typeof FLAGS;

export const FLAG_NAMES = Object.keys(FLAGS) as Flag[];

/** The known figures of a record. */
export function figuresOf(record: Record<string, unknown>): Figures {
  const figures: Figures = {};
  for (const name of FIGURE_NAMES) {
    const figure: Figure = FIGURES[name];
    const value = record[figure.column] ?? record[figure.ofRejected ?? ""];
    const number = typeof value === "bigint" ? Number(value) : value; // 64-bit columns of Parquet
    if (typeof number === "number" && Number.isFinite(number)) figures[name] = number;
  }
  return figures;
}

/** The marks of a record. */
export function flagsOf(record: Record<string, unknown>): Flag[] {
  const codes = record["validity_codes"];
  const found: Record<Flag, boolean> = {
    edge: record["touches_data_edge"] === true,
    curved: record["is_curved"] === true,
    overridden: typeof record["overridden"] === "string" && record["overridden"] !== "",
    faults: Array.isArray(codes) && codes.length > 0,
  };
  return FLAG_NAMES.filter((flag) => found[flag]);
}

/** A figure with its unit; null if the record does not have it. */
export function figureWords(name: FigureName, figures: Figures): string | null {
  const value = figures[name];
  if (value === undefined) return null;
  const { column, digits }: Figure = FIGURES[name];
  return shown(column, value, 1, digits);
}
