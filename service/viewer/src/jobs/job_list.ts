import { getJson, isOver, pathOfJob } from "../api/requests";
import type { StatusInfo } from "../api/types";
import { hashOf } from "../page/address";
import { el, refill } from "../page/elements";
import { chip } from "../page/tables";
import { JOBS_CHANGED } from "../page/view";
import { Watching } from "../page/watching";
import { pageLink } from "./downloads";
import { statusWords, titleOf, whenWords } from "./job_words";

const SHOWN = 20;
const REFRESH_MS = 4000;

/** The jobs, newest first; reloaded while one of them is under way. */
export class JobList extends Watching {
  private jobs: StatusInfo[] = [];
  private current = "";
  private readonly list = el("ul", { class: "jobs" });
  private readonly none = el("p", { class: "hint", hidden: true }, "None yet. Jobs stay here after a reload.");
  private readonly all = el("a", { class: "all-jobs", href: "#/jobs", hidden: true }, "All jobs");

  constructor(place: HTMLElement) {
    super(REFRESH_MS);
    document.addEventListener(JOBS_CHANGED, () => void this.load());
    place.replaceChildren(el("h2", { id: "jobs-title" }, "Jobs"), this.note, this.none, this.list, this.all);
    void this.load();
  }

  /** Show which job is open. */
  mark(jobId: string): void {
    this.current = jobId;
    this.draw();
  }

  protected async read(signal: AbortSignal): Promise<boolean> {
    const { jobs } = await getJson<{ jobs: StatusInfo[] }>(`jobs?limit=${SHOWN}`, { signal });
    if (signal.aborted) return false;
    this.jobs = jobs;
    this.none.hidden = jobs.length > 0;
    this.all.hidden = jobs.length === 0;
    this.draw();
    return jobs.some(({ status }) => !isOver(status));
  }

  private draw(): void {
    refill(this.list, ...this.jobs.map((job) => el("li", {}, this.entry(job), pageOf(job))));
  }

  private entry(job: StatusInfo): HTMLElement {
    const { jobID, scheduleID } = job;
    return el(
      "a",
      { class: "job", href: hashOf(["jobs", jobID]), "aria-current": jobID === this.current ? "page" : null },
      el("span", { class: "job-title" }, titleOf(job)),
      chip(job.status, statusWords(job)),
      el("span", { class: "job-when" }, whenWords(job)),
      scheduleID === undefined ? null : el("span", { class: "job-schedule", title: `Of schedule ${scheduleID}` }, "scheduled"),
    );
  }
}

/** The link to the page of a finished comparison. */
function pageOf(job: StatusInfo): HTMLElement | null {
  if (job.links?.some(({ type }) => type === "text/html") !== true) return null;
  return el("div", { class: "job-page" }, pageLink(pathOfJob(job.jobID), `Comparison of ${titleOf(job)}`));
}
