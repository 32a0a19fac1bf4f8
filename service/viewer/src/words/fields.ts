/** The words of the service for readers of the page: labels of fields in place of inputs of a process. */

/** Labels of the form's fields by the input that they set. */
export const LABELS = {
  crs: "CRS",
  verticalUnit: "Vertical unit",
  allowOutsideAreaOfUse: "Use the tiles where they lie",
  method: "Method",
  preset: "Preset",
  classes: "Classes of the file",
  footprints: "Footprints",
  footprintsLayer: "Layer of the footprints",
  guides: "Guides",
  points: "Keep the points",
  publish: "Publish as",
  title: "Title",
} as const;

/** Further formats of the models by the words of the input `publish`. */
export const FORMATS: Record<string, string> = {
  "3dtiles": "3D Tiles, for globes",
  geopackage: "GeoPackage, for GIS",
  pmtiles: "PMTiles, for web maps",
  cityjson: "CityJSON files",
  stac: "STAC catalogue",
  solar: "Solar energy of the roofs",
  "party-walls": "Party walls",
};

/** A message that names fields in place of inputs, and no settings of the operator. */
export function inFields(message: string): string {
  return message
    .replace(/\b(give|with)?( ?)the input (\w+)/gi, (whole: string, verb: string | undefined, space: string, name: string) => {
      if (!Object.hasOwn(LABELS, name)) return whole;
      const field = `“${LABELS[name as keyof typeof LABELS]}” under Options`;
      if (verb === undefined) return `${space}${field}`;
      return verb === "with" ? `in ${field}` : `${verb === "Give" ? "Set" : "set"} ${field}`;
    })
    .replace(/,? or add \S+ to GABLEWORK_\w+/g, "")
    .replace(/,? or raise GABLEWORK_\w+/g, ", or ask the operator of this service to raise the limit");
}

/** A text that begins with a capital letter. */
export function capital(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}
