/** Addresses of the page, and of one run of a comparison at the service. */

export interface Place {
  job: string;
  /** The run of a comparison whose models are shown, by its label; null for the first, and for other jobs. */
  method: string | null;
  building: string | null;
}

/** `#/jobs/<job>`, then `/methods/<label>` and `/buildings/<building>` if they are named; null for the start. */
export function placeOf(hash: string): Place | null {
  const { name, rest: [job, ...pairs] } = partsOf(hash);
  if (name !== "jobs" || job === undefined) return null;
  const named = (kind: string): string | null => pairs.find((_, i) => i % 2 === 1 && pairs[i - 1] === kind) ?? null;
  return { job, method: named("methods"), building: named("buildings") };
}

/** The address of a place; the query says what of it is shown. */
export function addressOf({ job, method, building }: Place, query = ""): string {
  const words = ["jobs", job, ...(method === null ? [] : ["methods", method]), ...(building === null ? [] : ["buildings", building])];
  return `${hashOf(words)}${query === "" ? "" : `?${query}`}`;
}

/** The query of an address: what follows the question mark; empty if there is none. */
export function queryOf(hash: string): string {
  const at = hash.indexOf("?");
  return at < 0 ? "" : hash.slice(at + 1);
}

/** What the page shows in place of a job: the words of its address, and what is asked of it. */
export interface Address {
  /** The first word: `jobs`, `schedules`, `webhooks` or `changes`. */
  name: string;
  /** The words after it. */
  rest: string[];
  query: URLSearchParams;
}

/** The parts of an address such as `#/webhooks/deliveries?state=failed`; the name is empty for the start. */
export function partsOf(hash: string): Address {
  const [path = "", query = ""] = hash.replace(/^#\/?/, "").split("?", 2);
  const [name = "", ...rest] = path.split("/").filter((word) => word !== "").map(decoded);
  return { name, rest, query: new URLSearchParams(query) };
}

/** An address of words and a query; members of the query that are empty are left out. */
export function hashOf(words: readonly string[], query: Readonly<Record<string, string>> = {}): string {
  const given = new URLSearchParams(Object.entries(query).filter(([, value]) => value !== "")).toString();
  return `#/${words.map(encodeURIComponent).join("/")}${given === "" ? "" : `?${given}`}`;
}

/** A word of an address; as it is if it was not encoded well. */
function decoded(word: string): string {
  try {
    return decodeURIComponent(word);
  } catch {
    return word;
  }
}
