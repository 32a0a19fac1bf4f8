import { getJson, isOver, type Problem, type StatusInfo } from "./api";
import { pageLink } from "./downloads";
import { el } from "./elements";
import { asProblem, problemNotice } from "./notices";
import { ago } from "./numbers";

const SHOWN = 30;
const REFRESH_MS = 4000;

export const STATUS_WORDS: Record<StatusInfo["status"], string> = {
  accepted: "waiting",
  running: "running",
  successful: "done",
  failed: "failed",
  dismissed: "cancelled",
};

/** The jobs, newest first; reloaded while one of them is under way. */
export class JobList {
  private jobs: StatusInfo[] = [];
  private current = "";
  private timer: number | undefined;
  private readonly list = el("ul", { class: "jobs" });
  private readonly note = el("div");

  constructor(
    place: HTMLElement,
    private readonly onProblem: (problem: Problem) => void,
  ) {
    place.replaceChildren(el("h2", { id: "jobs-title" }, "Jobs"), this.note, this.list);
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
    const running = job.status === "running" ? ` ${job.progress ?? 0} %` : "";
    return el(
      "a",
      {
        class: "job",
        href: `#/jobs/${encodeURIComponent(job.jobID)}`,
        "aria-current": job.jobID === this.current ? "page" : null,
      },
      el("span", { class: "job-title" }, titleOf(job)),
      el("span", { class: `chip chip-${job.status}` }, STATUS_WORDS[job.status] + running),
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
  return el("div", { class: "job-page" }, pageLink(`jobs/${encodeURIComponent(job.jobID)}`, `Comparison of ${titleOf(job)}`));
}

/** The user's title of a job, otherwise the beginning of its id. */
export function titleOf(job: StatusInfo): string {
  return job.title ?? `Job ${job.jobID.slice(0, 8)}`;
}
