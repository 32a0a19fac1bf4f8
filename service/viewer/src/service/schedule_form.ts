/** The form of a schedule: its times, and the request of its jobs. */

import { getJson, pathOfJob, sendJson } from "../api/requests";
import type { Schedule, StatusInfo } from "../api/types";
import { PROCESS_WORDS, titleOf } from "../jobs/job_words";
import { hashOf, type Address } from "../page/address";
import { el } from "../page/elements";
import { choice, field } from "../page/form_fields";
import { announce, asProblem, problemNotice } from "../page/notices";
import type { Hooks, View } from "../page/view";
import { ago } from "../words/numbers";
import { tileLines, USUAL, withTiles } from "./schedules";
import "../page/dialogs.css";
import "../page/pages.css";

const OFFERED = 50;

const OVERLAP = { skip: "skip the new time", wait: "wait until the job is over" };
const MISSED = { "run-latest": "run the latest of them once", skip: "run none of them" };

/** The fields of times that a new schedule and a change have in common. */
export class TimeFields {
  private readonly usual = choice("schedule-usual", { "": "other times", ...USUAL });
  private readonly cron = el("input", { type: "text", id: "schedule-cron", autocomplete: "off", spellcheck: "false" });
  private readonly zone = el("input", { type: "text", id: "schedule-zone", autocomplete: "off", spellcheck: "false", list: "zones" });
  private readonly title = el("input", { type: "text", id: "schedule-title", maxlength: 500, autocomplete: "off" });
  private readonly overlap = choice("schedule-overlap", OVERLAP);
  private readonly missed = choice("schedule-missed", MISSED);
  readonly elements: HTMLElement[];
  private suggested = "";

  constructor(before: Partial<Schedule>) {
    this.cron.value = before.cron ?? Object.keys(USUAL)[0] ?? "";
    this.zone.value = before.timeZone ?? Intl.DateTimeFormat().resolvedOptions().timeZone;
    this.title.value = before.title ?? "";
    this.overlap.value = before.overlap ?? "skip";
    this.missed.value = before.missed ?? "run-latest";
    this.usual.value = this.cron.value in USUAL ? this.cron.value : "";
    this.usual.addEventListener("change", () => {
      if (this.usual.value !== "") this.cron.value = this.usual.value;
      else this.cron.focus();
    });
    this.cron.addEventListener("input", () => (this.usual.value = this.cron.value in USUAL ? this.cron.value : ""));
    const zones = Intl.supportedValuesOf("timeZone").map((value) => el("option", { value }));
    this.elements = [
      field("Title", this.title, "Also that of its jobs."),
      field("When", this.usual),
      field("Times", this.cron, "Minute, hour, day of the month, month, day of the week, as in cron: 30 2 * * 1-5 is 02:30 on weekdays."),
      field("Time zone", this.zone),
      el("datalist", { id: "zones" }, ...zones),
      field("If the job before still runs", this.overlap),
      field("If the service was away at some times", this.missed),
    ];
  }

  /** Use a title if none was typed. */
  suggest(title: string): void {
    if (this.suggested === this.title.value) this.title.value = this.suggested = title;
  }

  value(): Record<string, unknown> {
    return {
      title: this.title.value.trim() || null,
      cron: this.cron.value.trim(),
      timeZone: this.zone.value.trim(),
      overlap: this.overlap.value,
      missed: this.missed.value,
    };
  }
}

/** A new schedule, from the request of a job. */
export function showNewSchedule(place: HTMLElement, { query }: Address, hooks: Hooks): View {
  const calledOff = new AbortController();
  document.title = "New schedule · gablework";
  const note = el("div");
  const jobs = el("select", { id: "schedule-job" });
  const tiles = el("textarea", { id: "schedule-tiles", rows: 3, spellcheck: "false" });
  const files = field(
    "Files",
    tiles,
    "One per line: uploads of this service, or URLs and paths that it may read. They are read anew each time; uploads never change.",
  );
  const times = new TimeFields({});
  const go = el("button", { type: "submit", class: "primary" }, "Make the schedule");
  let chosen: StatusInfo | null = null;
  const fail = (error: unknown): void => {
    if (calledOff.signal.aborted) return;
    const problem = asProblem(error);
    note.replaceChildren(problemNotice(problem));
    hooks.onProblem(problem);
  };
  const choose = async (id: string): Promise<void> => {
    chosen = null;
    note.replaceChildren();
    if (id === "") return;
    chosen = await getJson<StatusInfo>(pathOfJob(id), { signal: calledOff.signal });
    const inputs = chosen.request?.inputs ?? {};
    files.hidden = !("tiles" in inputs); // some processes have none
    tiles.value = tileLines(inputs);
    times.suggest(chosen.title ?? "");
  };
  const offer = async (): Promise<void> => {
    const asked = query.get("job") ?? "";
    const answer = await getJson<{ jobs: StatusInfo[] }>(`jobs?limit=${OFFERED}`, { signal: calledOff.signal });
    const known = answer.jobs.some(({ jobID }) => jobID === asked);
    const more = known || asked === "" ? [] : [await getJson<StatusInfo>(pathOfJob(asked), { signal: calledOff.signal })];
    const now = new Date();
    jobs.replaceChildren(
      el("option", { value: "" }, "choose a job"),
      ...[...more, ...answer.jobs].map((job) =>
        el("option", { value: job.jobID, selected: job.jobID === asked }, [titleOf(job), PROCESS_WORDS[job.processID ?? "reconstruct"] ?? "", job.created === undefined ? "" : ago(new Date(job.created), now)].join(" · ")),
      ),
    );
    await choose(asked);
  };
  jobs.addEventListener("change", () => void choose(jobs.value).catch(fail));
  const form = el(
    "form",
    { novalidate: true, class: "narrow" },
    field("Repeat this job", jobs, "Its method and settings are those of each run. Try them once before you repeat them."),
    files,
    ...times.elements,
    note,
    el("div", { class: "actions" }, go, el("a", { class: "button quiet", href: "#/schedules" }, "Cancel")),
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    if (go.getAttribute("aria-disabled") === "true") return;
    note.replaceChildren();
    if (chosen === null) {
      note.replaceChildren(el("div", { class: "notice notice-error", role: "alert" }, "Choose the job that is repeated."));
      jobs.focus();
      return;
    }
    const { processID = "reconstruct", request: before } = chosen;
    const inputs = before?.inputs ?? {};
    const execute = { ...before, inputs: "tiles" in inputs ? withTiles(inputs, tiles.value) : inputs };
    go.setAttribute("aria-disabled", "true");
    sendJson("POST", "schedules", { ...times.value(), processID, execute })
      .then(async (response) => {
        const { scheduleID } = (await response.json()) as Schedule;
        announce("The schedule is made.");
        location.hash = hashOf(["schedules", scheduleID]);
      }, fail)
      .finally(() => go.removeAttribute("aria-disabled"));
  });
  place.replaceChildren(
    el("div", { class: "sheet" }, el("div", { class: "sheet-head" }, el("h1", {}, "New schedule")), el("p", {}, el("a", { href: "#/schedules" }, "← All schedules")), form),
  );
  offer().catch(fail);
  return { follow: () => undefined, leave: () => calledOff.abort() };
}
