import { follow, type ServerEvent } from "../api/event_stream";
import { getJson, isOver, pathOfJob, Problem } from "../api/requests";
import type { JobEvent, StatusInfo } from "../api/types";
import { downloadList } from "../jobs/downloads";
import { cancellation, jobMenu } from "../jobs/job_actions";
import { failureRemedy, hasModels, titleOf } from "../jobs/job_words";
import { retry } from "../jobs/retry_form";
import type { Place } from "../page/address";
import { button, el } from "../page/elements";
import { announce, asProblem, problemNotice, report, warningNotice } from "../page/notices";
import { jobsChanged, type View } from "../page/view";
import { count, duration } from "../words/numbers";
import { BuildingsSoFar } from "./so_far";
import { stageNamed, stagesOf, type Stage } from "./stages";
import "./job_view.css";

/** Stages in which a job has some of its buildings. */
const HAS_MODELS = new Set(["reconstruct", "publish", "formats", "outputs"]);

/** Show a job: its progress, its failure or its results, which follow the address by themselves. */
export function showJob(place: HTMLElement, named: Place): View {
  const calledOff = new AbortController();
  let leaveResults: () => void = () => undefined;
  const path = pathOfJob(named.job);

  const look = async (): Promise<void> => {
    const job = await getJson<StatusInfo>(path, { signal: calledOff.signal });
    if (calledOff.signal.aborted) return;
    document.title = `${titleOf(job)} · gablework`;
    if (job.status === "successful" && !hasModels(job)) {
      place.replaceChildren(await files(job, path, calledOff.signal));
    } else if (job.status === "successful") {
      // the 3D library is loaded only if there is something to draw
      const { showResults } = await import("../results/results_view");
      if (calledOff.signal.aborted) return;
      leaveResults = showResults(place, job, named);
    } else if (isOver(job.status)) {
      place.replaceChildren(ended(job));
    } else {
      const soFar = job.processID === "reconstruct" ? new BuildingsSoFar(path, calledOff.signal) : null;
      const progress = new ProgressView(job, soFar);
      place.replaceChildren(progress.element);
      await progress.follow(path, calledOff.signal);
      jobsChanged();
      await look();
    }
  };

  place.replaceChildren(el("p", { class: "loading" }, "Loading…"));
  const begin = (): void => {
    look().catch((error: unknown) => {
      if (calledOff.signal.aborted) return;
      if (asProblem(error).kind === "no-such-job") {
        document.title = "No such job · gablework";
        place.replaceChildren(gone());
        return;
      }
      const card = el("div", { class: "card" });
      place.replaceChildren(card);
      report(card, error, begin);
    });
  };
  begin();
  const leave = (): void => {
    calledOff.abort();
    leaveResults();
  };
  return { follow: () => undefined, leave };
}

/** A job whose results are files without buildings. */
async function files(job: StatusInfo, path: string, signal: AbortSignal): Promise<HTMLElement> {
  const list = await downloadList({ jobPath: path, method: null }, signal);
  return el("div", { class: "card" }, heading(job), el("p", {}, job.message ?? ""), list);
}

/** A job that is over without results. */
function ended(job: StatusInfo): HTMLElement {
  const failure = job.exception;
  const notice =
    job.status === "failed"
      ? problemNotice(new Problem(0, failure?.title ?? "The job failed", failure?.detail ?? job.message ?? "", failureRemedy(job)))
      : el("p", {}, "This job was cancelled; its files are removed. Its tiles can be used again as long as the service keeps them.");
  const note = el("div");
  const again = (): void => {
    note.replaceChildren();
    retry(job).catch((error: unknown) => report(note, error));
  };
  const actions = el("div", { class: "actions" }, button("Try again…", again, { class: "primary" }));
  return el("div", { class: "card" }, heading(job), notice, note, actions);
}

function heading(job: StatusInfo, id?: string): HTMLElement {
  return el("div", { class: "job-head" }, el("h1", { id }, titleOf(job)), jobMenu(job));
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
  private known: Stage[];
  /** How far each stage is. */
  private readonly figures = new Map<string, string>();
  private readonly started: number;

  constructor(
    job: StatusInfo,
    private readonly soFar: BuildingsSoFar | null,
  ) {
    this.started = Date.parse(job.started ?? job.created ?? new Date().toISOString());
    this.known = stagesOf(job);
    const cancel = (): void => {
      // a second request would remove the job that the first has stopped
      if (stop.getAttribute("aria-disabled") === "true") return;
      stop.setAttribute("aria-disabled", "true"); // not `disabled`: it keeps the focus
      cancellation(job)
        .catch((error: unknown) => report(this.waiting, error))
        .finally(() => stop.removeAttribute("aria-disabled"));
    };
    const stop = button("Cancel the job", cancel, { class: "quiet" });
    this.element = el(
      "section",
      { class: "card progress", "aria-labelledby": "progress-title" },
      heading(job, "progress-title"),
      el("div", { class: "progress-line" }, this.bar, this.percent),
      el("div", { class: "progress-words" }, this.message, this.elapsed),
      this.waiting,
      this.stages,
      soFar?.element ?? "",
      this.warnings,
      el("div", { class: "actions" }, stop),
    );
    this.set(job.progress ?? 0, job.message ?? "");
    this.drawStages("");
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
    const one = stageNamed(stage);
    // what is compiled comes before all else
    if (!this.known.some(({ name }) => name === stage)) this.known = stage === "compile" ? [one, ...this.known] : [...this.known, one];
    if (event !== undefined && event.total > 1) this.figures.set(stage, `${count(event.done)} of ${count(event.total)} ${one.unit}`);
    this.drawStages(stage);
  }

  private drawStages(stage: string): void {
    const now = this.known.findIndex(({ name }) => name === stage);
    const rows = this.known.map(({ name, words }, i) => {
      const kind = i === now ? "stage stage-now" : i < now ? "stage stage-done" : "stage";
      const parts = [el("span", { class: "stage-name" }, words), el("span", { class: "stage-figure" }, this.figures.get(name))];
      return el("li", { class: kind, "aria-current": i === now ? "step" : null }, ...parts);
    });
    this.stages.replaceChildren(...rows);
  }

  private tick(): void {
    this.elapsed.textContent = duration((Date.now() - this.started) / 1000);
  }
}
