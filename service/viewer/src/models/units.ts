/** Units of a job's results: the page shows metres, whatever the files are in. */

import type { Units } from "../api/types";

/** Metres per unit of elevations that are properties of a building. */
export function elevationUnitM(crs: Units | null | undefined): number {
  return crs?.vertical_unit_m ?? 1;
}

/** Metres per unit of the coordinates in CityJSON. */
export function modelUnits(crs: Units | null | undefined): { horizontalUnitM: number; verticalUnitM: number } {
  return {
    horizontalUnitM: crs?.horizontal_unit_m ?? 1,
    verticalUnitM: crs?.cityjson_vertical_unit_m ?? elevationUnitM(crs),
  };
}

/** An elevation that is a property, in metres; null if it is none. */
export function inMetres(value: unknown, unitM: number): number | null {
  return typeof value === "number" ? value * unitM : null;
}
