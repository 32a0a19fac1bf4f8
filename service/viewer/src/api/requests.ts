/** The service's REST interface, as far as the page uses it. */

import { counted } from "../words/numbers";
import type { RunReport, Status } from "./types";

const KEY = "gablework.key";

/** The event of the document when a request needed a key, or another one; its detail is the problem. */
export const KEY_NEEDED = "key-needed";

declare global {
  interface DocumentEventMap {
    [KEY_NEEDED]: CustomEvent<Problem>;
  }
}

/** An error from the service as application/problem+json, or from the network. */
export class Problem extends Error {
  constructor(
    readonly status: number,
    readonly title: string,
    readonly detail: string,
    /** What to do about it. */
    readonly remedy: string,
    /** The kind of problem, the last part of its URI; empty if it has none. */
    readonly kind = "",
  ) {
    super(detail === "" ? title : `${title}: ${detail}`);
  }
}

export const isOver = (status: Status): boolean => status !== "accepted" && status !== "running";

/** The service's URL: the folder of the page, which includes the path prefix of a proxy. */
export function serviceUrl(path: string): string {
  return new URL(path, new URL(".", document.baseURI)).href;
}

/** The path of a job at the service. */
export const pathOfJob = (id: string): string => `jobs/${encodeURIComponent(id)}`;

/** A path of the service for one run of a comparison. */
export function ofRun(path: string, method: string | null): string {
  if (method === null) return path;
  return `${path}${path.includes("?") ? "&" : "?"}method=${encodeURIComponent(method)}`;
}

/** A job, or one run of a comparison. */
export interface Run {
  readonly jobPath: string;
  /** The run of a comparison; null for other jobs. */
  readonly method: string | null;
}

/** The path of a part of a run. */
export const partOf = ({ jobPath, method }: Run, part: string): string => ofRun(`${jobPath}/${part}`, method);

/** The path of a building of a run, or of a part of it. */
export const buildingOf = (run: Run, id: string, part = ""): string => partOf(run, `buildings/${encodeURIComponent(id)}${part}`);

/** The name of a variant in a comparison: the preset is named only if it is not the usual one. */
export function variantOf(method: string, preset: string, usualPreset: string): string {
  return preset === "" || preset === usualPreset ? method : `${method}:${preset}`;
}

/** The key of this browser tab; never stored for longer, never part of an address. */
export function currentKey(): string | null {
  return sessionStorage.getItem(KEY);
}

export function keepKey(key: string | null): void {
  if (key === null || key.trim() === "") sessionStorage.removeItem(KEY);
  else sessionStorage.setItem(KEY, key.trim());
}

export function authorization(): Record<string, string> {
  const key = currentKey();
  return key === null ? {} : { Authorization: `Bearer ${key}` };
}

/**
 * One request; the answer's status is 2xx.
 *
 * @throws Problem for every other answer, and if there is none.
 */
export async function request(path: string, options: RequestInit = {}): Promise<Response> {
  let response: Response;
  try {
    response = await fetch(serviceUrl(path), {
      cache: "no-store",
      ...options,
      headers: { Accept: "application/json", ...authorization(), ...(options.headers as Record<string, string>) },
    });
  } catch (error) {
    if (error instanceof DOMException && error.name === "AbortError") throw error;
    throw unreachable();
  }
  if (response.ok) return response;
  const problem = problemOf(response.status, response.statusText, await response.text(), response.headers.get("Retry-After"));
  if (problem.status === 401) document.dispatchEvent(new CustomEvent(KEY_NEEDED, { detail: problem }));
  throw problem;
}

export async function getJson<T>(path: string, options: RequestInit = {}): Promise<T> {
  return (await (await request(path, options)).json()) as T;
}

/** One request with a JSON document as its body. */
export function sendJson(method: string, path: string, body: unknown, headers: Record<string, string> = {}): Promise<Response> {
  return request(path, { method, headers: { "Content-Type": "application/json", ...headers }, body: JSON.stringify(body) });
}

/** The report of a run; empty if the request left it out. */
export async function runReport(run: Run, signal: AbortSignal): Promise<RunReport> {
  return (await orNull(getJson<RunReport>(partOf(run, "results/report"), { signal }))) ?? {};
}

/** Null for what the service does not have, such as the decisions of older jobs. */
export async function orNull<T>(asked: Promise<T>): Promise<T | null> {
  try {
    return await asked;
  } catch (error) {
    if (error instanceof Problem && error.status === 404) return null;
    throw error;
  }
}

export function unreachable(): Problem {
  return new Problem(0, "The service does not answer", "", "Check that it runs and that this machine can reach it, then try again.");
}

/** A problem from an answer; for another body the text of the status line. */
export function problemOf(status: number, reason: string, body: string, retryAfter: string | null): Problem {
  let document: Record<string, unknown> = {};
  try {
    document = (JSON.parse(body) as typeof document | null) ?? {};
  } catch {
    // the status says what is known
  }
  const text = (name: string): string => (typeof document[name] === "string" ? document[name] : "");
  const title = text("title") || reason || `Status ${status}`;
  const detail = text("detail");
  const kind = text("type").split(/[:/]/).at(-1) ?? "";
  // about keys, the service speaks to programmers and operators
  if (kind === "unauthorized") return new Problem(status, "This service needs a key", "", remedyOf(status, retryAfter), kind);
  if (kind === "forbidden") return new Problem(status, title, detail.split(": ")[0] ?? "", remedyOf(status, retryAfter), kind);
  return new Problem(status, title, detail, REMEDIES[kind] ?? remedyOf(status, retryAfter), kind);
}

/** What to do about a kind of problem, if its status does not say enough. */
const REMEDIES: Record<string, string> = {
  "target-refused": "Use another URL, or ask the operator of this service to allow this one.",
  "input-refused": "Use files that this service may read, or ask its operator to allow this one.",
  "no-such-upload": "The service no longer has this file. Send it again as a new job.",
  "schedule-busy": "Wait until that job is over, or cancel it.",
  "changed-meanwhile": "Close this, look at it as it is now, then change it.",
  "not-replayable": "Wait until the attempt that is under way is over.",
};

const CORRECT = "Correct what is named above and send it again.";
const REMOVED = "It may have been removed. Go back to the list.";

const BY_STATUS: Record<number, string> = {
  400: CORRECT,
  401: "Enter a valid key. The operator of this service gives you one.",
  403: "Your key may not do that. Ask the operator of this service for one that may.",
  404: REMOVED,
  410: REMOVED,
  413: "Split the tile, or ask the service's operator to raise the limit.",
  415: CORRECT,
  422: CORRECT,
  429: "Wait a little, then try again.",
  503: "The service cannot take work at the moment. Try again in a minute.",
};

function remedyOf(status: number, retryAfter: string | null): string {
  const seconds = Number(retryAfter);
  if (status === 429 && seconds > 0) return `Try again in ${counted(Math.ceil(seconds), "second")}.`;
  return BY_STATUS[status] ?? (status >= 500 ? "This is a fault of the service: its operator finds more in its log." : "");
}
