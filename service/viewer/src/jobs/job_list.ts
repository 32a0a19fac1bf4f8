import { getJson, isOver, pathOfJob, type Problem } from "../api/requests";
import type { StatusInfo } from "../api/types";
import { hashOf } from "../page/address";
import { el } from "../page/elements";
import { asProblem, problemNotice } from "../page/notices";
import { ago } from "../words/numbers";
import { pageLink } from "./downloads";
import { statusWords, titleOf } from "./job_words";

const SHOWN = 20;
const REFRESH_MS = 4000;

/** The jobs, newest first; reloaded while one of them is under way. */
export class JobList {
  private jobs: StatusInfo[] = [];
  private current = "";
  private timer: number | undefined;
  private readonly list = el("ul", { class: "jobs" });
  private readonly note = el("div");
  private readonly all = el("a", { class: "all-jobs", href: "#/jobs", hidden: true }, "All jobs");

  constructor(
    place: HTMLElement,
    private readonly onProblem: (problem: Problem) => void,
  ) {
    place.replaceChildren(el("h2", { id: "jobs-title" }, "Jobs"), this.note, this.list, this.all);
  }

  async start(): Promise<void> {
    await this.refresh();
  }

  async refresh(): Promise<void> {
    clearTimeout(this.timer);
    try {
      const answer = await getJson<{ jobs: StatusInfo[] }>(`jobs?limit=${SHOWN}`);
      this.jobs = answer.jobs;
      this.note.replaceChildren(
        this.jobs.length === 0 ? el("p", { class: "hint" }, "None yet. Jobs stay here after a reload.") : "",
      );
      this.all.hidden = this.jobs.length === 0;
      this.draw();
    } catch (error) {
      const problem = asProblem(error);
      this.note.replaceChildren(problemNotice(problem, () => void this.refresh()));
      this.onProblem(problem);
      return;
    }
    if (this.jobs.some((job) => !isOver(job.status))) {
      this.timer = window.setTimeout(() => void this.refresh(), REFRESH_MS);
    }
  }

  /** Show which job is open. */
  mark(jobId: string): void {
    this.current = jobId;
    this.draw();
  }

  private draw(): void {
    const now = new Date();
    const focused = this.list.contains(document.activeElement) ? document.activeElement?.getAttribute("href") : null;
    this.list.replaceChildren(...this.jobs.map((job) => el("li", {}, this.entry(job, now), pageOf(job))));
    if (focused != null) this.list.querySelector<HTMLAnchorElement>(`a[href="${CSS.escape(focused)}"]`)?.focus();
  }

  private entry(job: StatusInfo, now: Date): HTMLElement {
    return el(
      "a",
      {
        class: "job",
        href: hashOf(["jobs", job.jobID]),
        "aria-current": job.jobID === this.current ? "page" : null,
      },
      el("span", { class: "job-title" }, titleOf(job)),
      el("span", { class: `chip chip-${job.status}` }, statusWords(job)),
      el("span", { class: "job-when" }, job.created === undefined ? "" : ago(new Date(job.created), now)),
      job.scheduleID === undefined
        ? null
        : el("span", { class: "job-schedule", title: `Of schedule ${job.scheduleID}` }, "scheduled"),
    );
  }
}

/** The link to the page of a finished comparison. */
function pageOf(job: StatusInfo): HTMLElement | null {
  if (job.links?.some(({ type }) => type === "text/html") !== true) return null;
  return el("div", { class: "job-page" }, pageLink(pathOfJob(job.jobID), `Comparison of ${titleOf(job)}`));
}
