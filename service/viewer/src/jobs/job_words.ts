/** Jobs in words. */

import type { StatusInfo, Summary } from "../api/types";
import { ago, count, counted, duration } from "../words/numbers";

export const STATUS_WORDS: Record<StatusInfo["status"], string> = {
  accepted: "waiting",
  running: "running",
  successful: "done",
  failed: "failed",
  dismissed: "cancelled",
};

export const PROCESS_WORDS: Record<string, string> = {
  reconstruct: "Models",
  compare: "Comparison",
  classify: "Classification",
  echo: "Echo",
};

export const processWords = ({ processID = "reconstruct" }: { processID?: string }): string => PROCESS_WORDS[processID] ?? processID;

const MODELLED = new Set(["reconstruct", "compare"]);

/** The user's title of a job, otherwise the beginning of its id. */
export function titleOf(job: StatusInfo): string {
  return job.title ?? `Job ${job.jobID.slice(0, 8)}`;
}

/** Whether a job has models to look at; others have files alone. */
export const hasModels = ({ processID = "reconstruct" }: StatusInfo): boolean => MODELLED.has(processID);

/** The status, with the progress of a job that runs. */
export function statusWords(job: StatusInfo): string {
  return STATUS_WORDS[job.status] + (job.status === "running" ? ` ${job.progress ?? 0}\u202f%` : "");
}

/** What a job found, in a few words; empty if it has found nothing yet. */
export function resultWords({ status, summary, exception, message }: StatusInfo): string {
  if (status === "failed") return exception?.title ?? message ?? "";
  if (summary === undefined) return "";
  if (summary.runs !== undefined) {
    const runs = Object.values(summary.runs);
    return [counted(runs.length, "method"), buildings(runs[0])].filter((part) => part !== "").join(" · ");
  }
  if (summary.classes !== undefined) return counted(total(summary.classes), "point");
  return buildings(summary);
}

function buildings(summary: Summary | undefined): string {
  return summary?.statuses === undefined ? "" : buildingWords(summary.statuses);
}

/** How many buildings there are, and how many of them are not ok. */
export function buildingWords(statuses: Record<string, number>): string {
  const { doubtful = 0, fallback = 0, failed = 0 } = statuses;
  const parts = [counted(total(statuses), "building")];
  if (doubtful > 0) parts.push(`${count(doubtful)} doubtful`);
  if (fallback > 0) parts.push(counted(fallback, "block"));
  if (failed > 0) parts.push(`${count(failed)} failed`);
  return parts.join(" · ");
}

const total = (counts: Record<string, number>): number => Object.values(counts).reduce((sum, one) => sum + one, 0);

/** How long a job has run up to now, or ran; empty if it never did. */
export function durationWords({ started, finished }: StatusInfo): string {
  if (started === undefined) return "";
  const end = finished === undefined ? Date.now() : Date.parse(finished);
  return duration((end - Date.parse(started)) / 1000);
}

/** How long ago it was created; empty if that is unknown. */
export function whenWords({ created }: StatusInfo): string {
  return created === undefined ? "" : ago(created);
}

const REMEDIES: Record<string, string> = {
  input:
    "If an option is wrong, such as the CRS, try again with another one. If the file itself is damaged, send it again as a new job.",
  settings: "Try again and correct the settings that are named above.",
  refused: "Cut the tile into smaller ones, or ask the operator of this service to allow it.",
  cluster: "The computers that do the work were away. Try again; ask the operator of this service if it fails once more.",
  lost: "The work ended the program several times, mostly for lack of memory. Try a smaller rectangle or tile, or ask the operator of this service for more memory.",
  stalled: "The work stood still, or ended its own program, several times. Ask the operator of this service to look at it: only an operator can try it again.",
  "no-space": "Remove jobs that you no longer need, then try again.",
  internal: "Try again once. If it fails once more, send the operator of this service the message above.",
};

/** What to do about a job that failed. */
export function failureRemedy(job: StatusInfo): string {
  const kind = job.exception?.type?.split(":").at(-1)?.replace("job-failed-", "") ?? "";
  return REMEDIES[kind] ?? "Fix the cause and try again.";
}
