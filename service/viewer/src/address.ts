/** Addresses of the page, and of one run of a comparison at the service. */

export interface Place {
  job: string;
  /** The run of a comparison whose models are shown, by its label; null for the first, and for other jobs. */
  method: string | null;
  building: string | null;
}

const PLACE = /^#\/jobs\/([^/]+)(?:\/methods\/([^/]+))?(?:\/buildings\/([^/]+))?/;

/** `#/jobs/<job>`, then `/methods/<label>` and `/buildings/<building>` if they are named; null for the start. */
export function placeOf(hash: string): Place | null {
  const found = PLACE.exec(hash);
  if (found === null) return null;
  const [job, method, building] = found.slice(1).map((part) => (part === undefined ? null : decodeURIComponent(part)));
  return { job: job ?? "", method: method ?? null, building: building ?? null };
}

export function addressOf({ job, method, building }: Place): string {
  const parts = [["jobs", job], ["methods", method], ["buildings", building]] as const;
  return "#" + parts.map(([name, value]) => (value === null ? "" : `/${name}/${encodeURIComponent(value)}`)).join("");
}

/** A path of the service for one run of a comparison. */
export function ofRun(path: string, method: string | null): string {
  if (method === null) return path;
  return `${path}${path.includes("?") ? "&" : "?"}method=${encodeURIComponent(method)}`;
}

/** The name of a variant in a comparison: the preset is named only if it is not the usual one. */
export function variantOf(method: string, preset: string, usualPreset: string): string {
  return preset === "" || preset === usualPreset ? method : `${method}:${preset}`;
}
