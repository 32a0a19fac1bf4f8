/** The columns of a building's record that the page shows, with their labels, units and digits. */

import { count, measure } from "../words/numbers";
import { inMetres } from "./units";

interface Column {
  label: string;
  /** `%` for a share; empty for a number of things. */
  unit: string;
  digits: number;
  section: "Height" | "Size" | "Fit to the points";
  /** It is in the elevation's unit of the run. */
  isElevation?: boolean;
}

export const COLUMNS = {
  height_m: { label: "Ridge above floor", unit: "m", digits: 2, section: "Height" },
  ground_z: { label: "Ground", unit: "m", digits: 2, section: "Height", isElevation: true },
  eave_z: { label: "Eaves", unit: "m", digits: 2, section: "Height", isElevation: true },
  ridge_z: { label: "Ridge", unit: "m", digits: 2, section: "Height", isElevation: true },
  h_50p: { label: "Median of the roof", unit: "m", digits: 2, section: "Height", isElevation: true },
  footprint_area_m2: { label: "Footprint", unit: "m²", digits: 1, section: "Size" },
  roof_area_m2: { label: "Roof, slanted", unit: "m²", digits: 1, section: "Size" },
  volume_m3: { label: "Volume", unit: "m³", digits: 0, section: "Size" },
  n_planes: { label: "Roof planes", unit: "", digits: 0, section: "Size" },
  share_within_0_2m: { label: "Within 0.2 m of the roof", unit: "%", digits: 1, section: "Fit to the points" },
  rmse_m: { label: "RMSE", unit: "m", digits: 3, section: "Fit to the points" },
  p95_m: { label: "95th percentile", unit: "m", digits: 3, section: "Fit to the points" },
  coverage: { label: "Points covered", unit: "%", digits: 1, section: "Fit to the points" },
  share_below_roof: { label: "Points on facades and below", unit: "%", digits: 1, section: "Fit to the points" },
  footprint_share: { label: "Given footprint covered", unit: "%", digits: 1, section: "Fit to the points" },
  noise_m: { label: "Noise of the points", unit: "m", digits: 3, section: "Fit to the points" },
  ridge_z_sigma_m: { label: "Ridge uncertainty (one sigma)", unit: "m", digits: 3, section: "Fit to the points" },
  unexplained_m2: { label: "Roof unexplained by points", unit: "m²", digits: 1, section: "Fit to the points" },
  extrapolated_share: { label: "Roof that was not seen", unit: "%", digits: 1, section: "Fit to the points" },
  largest_hole_m: { label: "Largest hole in the points", unit: "m", digits: 1, section: "Fit to the points" },
  detection_confidence: { label: "Confidence that it is a building", unit: "%", digits: 1, section: "Fit to the points" },
  n_points: { label: "Points", unit: "", digits: 0, section: "Fit to the points" },
  density_per_m2: { label: "Density", unit: "per m²", digits: 1, section: "Fit to the points" },
} as const satisfies Record<string, Column>;

export type ColumnName = keyof typeof COLUMNS;

export const COLUMN_NAMES = Object.keys(COLUMNS) as ColumnName[];

/** Shown value over stored value. */
export const factorOf = (column: ColumnName): number => (COLUMNS[column].unit === "%" ? 100 : 1);

/**
 * A value of a column as the page shows it.
 *
 * @param elevationUnitM Metres per unit of elevations.
 * @param digits Decimals in place of the usual ones.
 */
export function shown(column: ColumnName, value: unknown, elevationUnitM = 1, digits?: number): string {
  const { unit, digits: usual, isElevation = false }: Column = COLUMNS[column];
  const metric = isElevation ? inMetres(value, elevationUnitM) : value;
  if (typeof metric !== "number") return "–";
  return unit === "" ? count(metric) : measure(metric * factorOf(column), digits ?? usual, unit);
}
