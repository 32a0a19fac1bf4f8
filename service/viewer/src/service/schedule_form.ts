/** The form of a schedule: its times, and the request of its jobs. */

import { getJson, pathOfJob, Problem, sendJson } from "../api/requests";
import type { Schedule, StatusInfo } from "../api/types";
import { processWords, titleOf, whenWords } from "../jobs/job_words";
import { hashOf, type Address } from "../page/address";
import { sentForm } from "../page/dialogs";
import { el } from "../page/elements";
import { choice, field } from "../page/form_fields";
import { announce, report } from "../page/notices";
import { backLink, sheet } from "../page/sheet";
import type { View } from "../page/view";
import { tileLines, USUAL, withTiles } from "./schedules";

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
export function showNewSchedule(place: HTMLElement, { query }: Address): View {
  const calledOff = new AbortController();
  const { signal } = calledOff;
  const note = el("div");
  const jobs = el("select", { id: "schedule-job" });
  const tiles = el("textarea", { id: "schedule-tiles", rows: 3, spellcheck: "false" });
  const files = field(
    "Files",
    tiles,
    "One per line: uploads of this service, or URLs and paths that it may read. They are read anew each time; uploads never change.",
  );
  const times = new TimeFields({});
  let chosen: StatusInfo | null = null;
  const fail = (error: unknown): void => {
    if (!signal.aborted) report(note, error);
  };
  const choose = async (id: string): Promise<void> => {
    chosen = null;
    note.replaceChildren();
    if (id === "") return;
    chosen = await getJson<StatusInfo>(pathOfJob(id), { signal });
    const inputs = chosen.request?.inputs ?? {};
    files.hidden = !("tiles" in inputs); // some processes have none
    tiles.value = tileLines(inputs);
    times.suggest(chosen.title ?? "");
  };
  const offer = async (): Promise<void> => {
    const asked = query.get("job") ?? "";
    const { jobs: newest } = await getJson<{ jobs: StatusInfo[] }>(`jobs?limit=${OFFERED}`, { signal });
    if (asked !== "" && !newest.some(({ jobID }) => jobID === asked)) newest.unshift(await getJson<StatusInfo>(pathOfJob(asked), { signal }));
    const words = (job: StatusInfo): string => [titleOf(job), processWords(job), whenWords(job)].join(" · ");
    jobs.replaceChildren(
      el("option", { value: "" }, "choose a job"),
      ...newest.map((job) => el("option", { value: job.jobID, selected: job.jobID === asked }, words(job))),
    );
    await choose(asked);
  };
  jobs.addEventListener("change", () => void choose(jobs.value).catch(fail));
  const act = async (): Promise<void> => {
    if (chosen === null) {
      jobs.focus();
      throw new Problem(0, "Choose the job that is repeated.", "", "");
    }
    const { processID = "reconstruct", request: before } = chosen;
    const inputs = before?.inputs ?? {};
    const execute = { ...before, inputs: "tiles" in inputs ? withTiles(inputs, tiles.value) : inputs };
    const response = await sendJson("POST", "schedules", { ...times.value(), processID, execute });
    const { scheduleID } = (await response.json()) as Schedule;
    announce("The schedule is made.");
    location.hash = hashOf(["schedules", scheduleID]);
  };
  const hint = "Its method and settings are those of each run. Try them once before you repeat them.";
  const form = sentForm(
    { content: [field("Repeat this job", jobs, hint), files, ...times.elements, note], send: "Make the schedule", act },
    el("a", { class: "button quiet", href: "#/schedules" }, "Cancel"),
    () => undefined,
  );
  form.classList.add("narrow");
  place.replaceChildren(sheet("New schedule", [], backLink("#/schedules", "All schedules"), form));
  offer().catch(fail);
  return { follow: () => undefined, leave: () => calledOff.abort() };
}
