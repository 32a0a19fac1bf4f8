/** What can be done with a job: try it again, keep it, repeat it, cancel it, remove it. */

import { getJson, isOver, pathOfJob, request, sendJson } from "../api/requests";
import type { Status, StatusInfo } from "../api/types";
import { actionMenu, type Item } from "../page/action_menu";
import { hashOf } from "../page/address";
import { ask } from "../page/dialogs";
import { announce } from "../page/notices";
import { jobsChanged } from "../page/view";
import { hasModels, titleOf } from "./job_words";
import { retry } from "./retry_form";

/** A menu of all of it. */
export function jobMenu(job: StatusInfo): HTMLElement {
  let now = job;
  const items = (): Item[] => {
    const over = isOver(now.status);
    const keeping = async (): Promise<void> => {
      now = await keep(now);
    };
    return [
      ...(over ? [{ label: "Try again…", act: () => retry(now) }] : []),
      { label: now.keep === true ? "No longer keep it" : "Keep it", act: keeping },
      ...comparing(now),
      { label: "Repeat on a schedule…", href: hashOf(["schedules", "new"], { job: now.jobID }) },
      { label: "Messages about it", href: hashOf(["webhooks"], { job: now.jobID }) },
      over
        ? { label: "Remove…", act: () => removal(now) }
        : { label: "Cancel…", act: () => cancellation(now) },
    ];
  };
  return actionMenu(titleOf(job), items);
}

/** The way to the models of two runs side by side, of those of a comparison or of another job. */
function comparing(job: StatusInfo): Item[] {
  if (job.status !== "successful" || !hasModels(job)) return [];
  const [oldMethod = "", newMethod = ""] = Object.keys(job.summary?.runs ?? {});
  if (newMethod === "") return [{ label: "Compare with another…", href: hashOf(["changes"], { old: job.jobID }) }];
  return [{ label: "Two methods in 3D", href: hashOf(["changes"], { old: job.jobID, oldMethod, new: job.jobID, newMethod }) }];
}

/** Keep a job whatever its age and size, or no longer; returns it as it is now. */
async function keep(job: StatusInfo): Promise<StatusInfo> {
  const response = await sendJson("PATCH", pathOfJob(job.jobID), { keep: job.keep !== true });
  const now = (await response.json()) as StatusInfo;
  announce(now.keep === true ? "The job is kept." : "The job is no longer kept.");
  jobsChanged();
  return { ...job, ...now };
}

/**
 * Ask, then stop a job. One that waits is stopped at once: no work is lost.
 *
 * The service says whether it waits, runs or is over: what the page shows may be older. Of a job that is over the same
 * request would remove the results.
 */
export async function cancellation(job: StatusInfo): Promise<void> {
  const look = async (): Promise<Status> => (await getJson<StatusInfo>(pathOfJob(job.jobID))).status;
  const stop = async (status: Status): Promise<void> => {
    if (!isOver(status)) await request(pathOfJob(job.jobID), { method: "DELETE" });
    announce(isOver(status) ? "The job is over already." : "The job is cancelled.");
    jobsChanged();
  };
  const status = await look();
  if (status !== "running") return stop(status);
  ask("Cancel the job?", `“${titleOf(job)}” is running. What it has done so far is lost.`, {
    send: "Cancel the job",
    act: async () => stop(await look()), // it may have ended before the answer
  });
}

/** Ask, then remove a job with its results; the page leaves it if it shows it. */
function removal(job: StatusInfo): void {
  ask("Remove the job?", `“${titleOf(job)}” and its results are removed from the service. Files that you have downloaded stay.`, {
    send: "Remove it",
    act: async () => {
      await request(pathOfJob(job.jobID), { method: "DELETE" });
      announce("The job is removed.");
      jobsChanged();
      if (location.hash.startsWith(hashOf(["jobs", job.jobID]))) location.hash = "#/jobs";
    },
  });
}
