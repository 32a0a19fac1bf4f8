import { follow, type ServerEvent } from "../api/event_stream";
import { getJson, isOver, pathOfJob, Problem } from "../api/requests";
import type { JobEvent, StatusInfo } from "../api/types";
import { downloadList } from "../jobs/downloads";
import { cancellation, jobMenu, retry } from "../jobs/job_actions";
import { failureRemedy, MODELLED, titleOf } from "../jobs/job_words";
import type { Place } from "../page/address";
import { el } from "../page/elements";
import { announce, asProblem, problemNotice, warningNotice } from "../page/notices";
import type { Hooks } from "../page/view";
import { count, duration } from "../words/numbers";
import { BuildingsSoFar } from "./so_far";
import { stageNamed, stagesOf, type Stage } from "./stages";
import "./job_view.css";

/** Stages in which a job has some of its buildings. */
const HAS_MODELS = new Set(["reconstruct", "publish", "formats", "outputs"]);

/** Show a job: its progress, its failure or its results. Returns a function that ends the view. */
export function showJob(place: HTMLElement, named: Place, hooks: Hooks): () => void {
  const calledOff = new AbortController();
  let leaveResults: () => void = () => undefined;
  const path = pathOfJob(named.job);

  const look = async (): Promise<void> => {
    const job = await getJson<StatusInfo>(path, { signal: calledOff.signal });
    if (calledOff.signal.aborted) return;
    document.title = `${titleOf(job)} · gablework`;
    if (job.status === "successful" && !MODELLED.has(job.processID ?? "reconstruct")) {
      place.replaceChildren(await files(job, path, hooks, calledOff.signal));
    } else if (job.status === "successful") {
      // the 3D library is loaded only if there is something to draw
      const { showResults } = await import("../results/results_view");
      if (calledOff.signal.aborted) return;
      leaveResults = showResults(place, job, named, hooks);
    } else if (isOver(job.status)) {
      place.replaceChildren(ended(job, hooks));
    } else {
      const soFar = job.processID === "reconstruct" ? new BuildingsSoFar(path, calledOff.signal) : null;
      const progress = new ProgressView(job, soFar, hooks);
      place.replaceChildren(progress.element);
      await progress.follow(path, calledOff.signal);
      hooks.onChange();
      await look();
    }
  };

  place.replaceChildren(el("p", { class: "loading" }, "Loading…"));
  const begin = (): void => {
    look().catch((error: unknown) => {
      if (calledOff.signal.aborted) return;
      const problem = asProblem(error);
      if (problem.kind === "no-such-job") {
        document.title = "No such job · gablework";
        place.replaceChildren(gone());
        return;
      }
      place.replaceChildren(el("div", { class: "card" }, problemNotice(problem, begin)));
      hooks.onProblem(problem);
    });
  };
  begin();
  return () => {
    calledOff.abort();
    leaveResults();
  };
}

/** A job whose results are files without buildings. */
async function files(job: StatusInfo, path: string, hooks: Hooks, signal: AbortSignal): Promise<HTMLElement> {
  const list = await downloadList(path, null, signal);
  return el("div", { class: "card" }, heading(job, hooks), el("p", {}, job.message ?? ""), list);
}

/** A job that is over without results. */
function ended(job: StatusInfo, hooks: Hooks): HTMLElement {
  const failure = job.exception;
  const notice =
    job.status === "failed"
      ? problemNotice(new Problem(0, failure?.title ?? "The job failed", failure?.detail ?? job.message ?? "", failureRemedy(job)))
      : el("p", {}, "This job was cancelled; its files are removed. Its tiles can be used again as long as the service keeps them.");
  const note = el("div");
  const again = el("button", { type: "button", class: "primary" }, "Try again…");
  again.addEventListener("click", () => {
    note.replaceChildren();
    retry(job, hooks).catch((error: unknown) => {
      const problem = asProblem(error);
      note.replaceChildren(problemNotice(problem));
      hooks.onProblem(problem);
    });
  });
  return el("div", { class: "card" }, heading(job, hooks), notice, note, el("div", { class: "actions" }, again));
}

function heading(job: StatusInfo, hooks: Hooks): HTMLElement {
  return el("div", { class: "job-head" }, el("h1", {}, titleOf(job)), jobMenu(job, hooks));
}

/** A job that the service does not have: its address is old. */
function gone(): HTMLElement {
  return el(
    "div",
    { class: "card" },
    el("h1", {}, "This job is not here"),
    el("p", {}, "It was removed by hand, or by its age: some services remove old jobs. Or it belongs to another key."),
    el("div", { class: "actions" }, el("a", { class: "button primary", href: "#/jobs" }, "All jobs")),
  );
}

class ProgressView {
  readonly element: HTMLElement;
  private readonly bar = el("progress", { max: 100, "aria-label": "Progress of the job" });
  private readonly percent = el("span", { class: "percent" });
  private readonly message = el("p", { class: "message" });
  private readonly waiting = el("div");
  private readonly warnings = el("div");
  private readonly elapsed = el("span", { class: "elapsed" });
  private readonly stages = el("ol", { class: "stages" });
  private readonly shown: string[] = [];
  private readonly rows = new Map<string, { row: HTMLElement; figure: HTMLElement }>();
  private readonly started: number;

  constructor(
    job: StatusInfo,
    private readonly soFar: BuildingsSoFar | null,
    hooks: Hooks,
  ) {
    this.started = Date.parse(job.started ?? job.created ?? new Date().toISOString());
    for (const stage of stagesOf(job)) this.addStage(stage);
    const button = el("button", { type: "button", class: "quiet" }, "Cancel the job");
    button.addEventListener("click", () => {
      // a second request would remove the job that the first has stopped
      if (button.getAttribute("aria-disabled") === "true") return;
      button.setAttribute("aria-disabled", "true"); // not `disabled`: it keeps the focus
      cancellation(job, hooks)
        .catch((error: unknown) => this.waiting.replaceChildren(problemNotice(asProblem(error))))
        .finally(() => button.removeAttribute("aria-disabled"));
    });
    this.element = el(
      "section",
      { class: "card progress", "aria-labelledby": "progress-title" },
      el("div", { class: "job-head" }, el("h1", { id: "progress-title" }, titleOf(job)), jobMenu(job, hooks)),
      el("div", { class: "progress-line" }, this.bar, this.percent),
      el("div", { class: "progress-words" }, this.message, this.elapsed),
      this.waiting,
      this.stages,
      soFar?.element ?? "",
      this.warnings,
      el("div", { class: "actions" }, button),
    );
    this.set(job.progress ?? 0, job.message ?? "");
    if (job.stage !== undefined) this.enter(job.stage);
  }

  /** Live until the job is over. */
  async follow(path: string, signal: AbortSignal): Promise<void> {
    const clock = setInterval(() => this.tick(), 1000);
    this.tick();
    try {
      await follow(
        `${path}/events`,
        (event) => this.take(event),
        (connected) => {
          if (!connected) this.message.textContent = "The connection was lost; trying again…";
        },
        signal,
      );
    } finally {
      clearInterval(clock);
    }
  }

  /** Show one event; true when it was the last. */
  private take({ data }: ServerEvent): boolean {
    const event = JSON.parse(data) as JobEvent;
    this.waiting.replaceChildren(...(event.kind === "waiting" ? [warningNotice(event.message)] : []));
    if (event.kind === "warning") {
      if (!this.shown.includes(event.message)) this.shown.push(event.message);
      this.warnings.replaceChildren(warningNotice(...this.shown));
      return false;
    }
    this.set(event.progress, event.message);
    if (event.stage !== "") this.enter(event.stage, event);
    return event.status !== undefined && isOver(event.status);
  }

  private set(progress: number, message: string): void {
    this.bar.value = progress;
    this.percent.textContent = `${progress}\u202f%`;
    if (message !== "") {
      this.message.textContent = message;
      announce(message);
    }
    document.title = document.title.replace(/^(\d+\u202f% )?/, `${progress}\u202f% `);
  }

  private enter(stage: string, event?: JobEvent): void {
    if (HAS_MODELS.has(stage)) this.soFar?.begin();
    if (!this.rows.has(stage)) this.addStage(stageNamed(stage), stage === "compile");
    let before = true;
    for (const [name, { row, figure }] of this.rows) {
      if (name === stage) {
        before = false;
        row.className = "stage stage-now";
        row.setAttribute("aria-current", "step");
        if (event !== undefined && event.total > 1) figure.textContent = `${count(event.done)} of ${count(event.total)} ${stageNamed(name).unit}`;
      } else {
        row.className = before ? "stage stage-done" : "stage";
        row.removeAttribute("aria-current");
      }
    }
  }

  private addStage({ name, words }: Stage, isFirst = false): void {
    const figure = el("span", { class: "stage-figure" });
    const row = el("li", { class: "stage" }, el("span", { class: "stage-name" }, words), figure);
    if (isFirst) {
      // rows are in the order of the stages
      const others = [...this.rows];
      this.rows.clear();
      this.rows.set(name, { row, figure });
      for (const [known, place] of others) this.rows.set(known, place);
      this.stages.prepend(row);
      return;
    }
    this.rows.set(name, { row, figure });
    this.stages.append(row);
  }

  private tick(): void {
    this.elapsed.textContent = duration((Date.now() - this.started) / 1000);
  }
}
