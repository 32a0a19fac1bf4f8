/** Units of a job's results: the page shows metres, whatever the files are in. */

/** The entry `crs` of a report, as far as units go. */
export interface Units {
  horizontal_unit_m?: number | null;
  /** Metres per unit of the elevations in tables. */
  vertical_unit_m?: number | null;
  /** The same for CityJSON; older reports lack it, where both are equal. */
  cityjson_vertical_unit_m?: number | null;
}

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
