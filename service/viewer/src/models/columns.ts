/** The columns of a building's record that the page shows, with their labels, units and digits. */

import { count, measure } from "../words/numbers";
import { TABLES } from "../words/tables";
import { inMetres } from "./units";

export const COLUMNS = TABLES.columns;

export const COLUMN_NAMES = Object.keys(COLUMNS);

/** Shown value over stored value. */
export const factorOf = (column: string): number => (COLUMNS[column]?.unit === "%" ? 100 : 1);

/**
 * A value of a column as the page shows it.
 *
 * @param elevationUnitM Metres per unit of elevations.
 * @param digits Decimals in place of the usual ones.
 */
export function shown(column: string, value: unknown, elevationUnitM = 1, digits?: number): string {
  const { unit, digits: usual, isElevation } = COLUMNS[column];
  const metric = isElevation ? inMetres(value, elevationUnitM) : value;
  if (typeof metric !== "number") return "–";
  return unit === "" ? count(metric) : measure(metric * factorOf(column), digits ?? usual, unit);
}
