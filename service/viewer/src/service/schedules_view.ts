/** Schedules: the list, and one of them with its next times and its runs. */

import { getJson, request, sendJson } from "../api/requests";
import type { Schedule, ScheduleRun, StatusInfo } from "../api/types";
import { processWords } from "../jobs/job_words";
import { actionMenu, type Item } from "../page/action_menu";
import { hashOf, type Address } from "../page/address";
import { ask, openForm } from "../page/dialogs";
import { el, type Child } from "../page/elements";
import { announce } from "../page/notices";
import { offsetOf, pager } from "../page/paging";
import { backLink, rawText, section, sheet } from "../page/sheet";
import { chip, facts, nothing, sub, table, type Column } from "../page/tables";
import { jobsChanged, type View } from "../page/view";
import { hasNext, SIZE, WatchedList, type Answer } from "../page/watched_list";
import { WatchedPage } from "../page/watched_page";
import { ago } from "../words/numbers";
import { showNewSchedule, TimeFields } from "./schedule_form";
import { clockWords, countWords, outcomeWords, slotWords, tileLines } from "./schedules";

const REFRESH_MS = 10_000;

export function showSchedules(place: HTMLElement, address: Address): View {
  const [id] = address.rest;
  if (id === "new") return showNewSchedule(place, address);
  return id === undefined ? new ScheduleList(place) : new ScheduleView(place, id);
}

/** A menu of all that can be done with a schedule. */
function scheduleMenu(one: Schedule, changed: () => Promise<void>, removed: () => void): HTMLElement {
  const path = pathOf(one.scheduleID);
  const runNow = async (): Promise<void> => {
    const response = await request(`${path}/run`, { method: "POST" });
    const { jobID } = (await response.json()) as StatusInfo;
    announce("The job is submitted.");
    jobsChanged();
    location.hash = hashOf(["jobs", jobID]);
  };
  const change = async (changes: Record<string, unknown>, words: string): Promise<void> => {
    // a change that someone else made meanwhile is not overwritten
    await sendJson("PATCH", path, changes, { "If-Match": `"${one.version}"` });
    announce(words);
    await changed();
  };
  const edit = (): void => {
    const times = new TimeFields(one);
    openForm("Change the times", {
      content: times.elements,
      send: "Save",
      act: () => change(times.value(), "The schedule is changed."),
    });
  };
  const remove = (): void =>
    ask("Remove the schedule?", `“${nameOf(one)}” runs no more, and the history of its times is deleted. Its jobs stay.`, {
      send: "Remove it",
      act: async () => {
        await request(path, { method: "DELETE" });
        announce("The schedule is removed.");
        removed();
      },
    });
  const paused = one.state === "paused";
  const items: Item[] = [
    { label: "Run now", act: runNow },
    { label: paused ? "Resume" : "Pause", act: () => change({ paused: !paused }, paused ? "It is resumed." : "It is paused.") },
    { label: "Change the times…", act: edit },
    { label: "Its jobs", href: hashOf(["jobs"], { scheduleID: one.scheduleID }) },
    { label: "Remove…", act: remove },
  ];
  return actionMenu(nameOf(one), () => items);
}

class ScheduleList extends WatchedList<Schedule> {
  protected readonly columns: Column<Schedule>[] = [
    {
      head: "Schedule",
      cell: (one) => [
        el("a", { href: hashOf(["schedules", one.scheduleID]) }, nameOf(one)),
        sub(`${one.cron} · ${one.timeZone} · ${processWords(one)}`),
        el("span", { class: "sub only-narrow" }, `next ${nextWords(one)}`),
      ],
    },
    { head: "State", cell: ({ state }) => chip(state) },
    { head: "Next time", kind: "only-wide", cell: nextWords },
    { head: "Last time", kind: "only-wide", cell: ({ lastRun }) => (lastRun === undefined ? "–" : [outcomeChip(lastRun), ` ${ago(lastRun.at)}`]) },
    { head: "Actions", kind: "acts", cell: (one) => scheduleMenu(one, () => this.load(), () => void this.load()) },
  ];
  protected readonly empty = "No schedules yet. Make one from a job that went well: Actions, Repeat on a schedule.";
  protected readonly filters = {};

  constructor(place: HTMLElement) {
    super({ name: "Schedules", noun: "schedule", path: "schedules", member: "schedules", words: ["schedules"], refreshMs: REFRESH_MS });
    const make = el("a", { class: "button", href: "#/schedules/new" }, "New schedule…");
    const hint = el("p", { class: "hint" }, "Jobs that the service repeats by itself at fixed times.");
    place.replaceChildren(sheet("Schedules", [make], hint, this.note, this.frame, this.pages));
  }

  protected mayChange(): boolean {
    return true;
  }
}

type Runs = Answer & { runs: ScheduleRun[] };

class ScheduleView extends WatchedPage<[Schedule, Runs]> {
  private offset = 0;

  constructor(
    place: HTMLElement,
    private readonly id: string,
  ) {
    super(place, "Schedule", backLink("#/schedules", "All schedules"), REFRESH_MS);
  }

  override follow(address: Address): void {
    this.offset = offsetOf(address.query.get("offset"));
    super.follow(address);
  }

  protected get(signal: AbortSignal): Promise<[Schedule, Runs]> {
    const path = pathOf(this.id);
    const runs = getJson<Runs>(`${path}/runs?limit=${SIZE}&offset=${this.offset}`, { signal });
    return Promise.all([getJson<Schedule>(path, { signal }), runs]);
  }

  protected mayChange(): boolean {
    return true;
  }

  protected parts([one, answer]: [Schedule, Runs]): [HTMLElement, ...HTMLElement[]] {
    const zone = one.timeZone;
    const { runs } = answer;
    const inputs = one.execute?.inputs ?? {};
    const files = tileLines(inputs).split("\n").filter((line) => line !== "");
    const next = one.nextTimes.map((time) => el("li", {}, clockWords(time, zone)));
    const page = { offset: this.offset, size: SIZE, shown: runs.length, total: null, hasNext: hasNext(answer) };
    const leave = (): void => {
      location.hash = "#/schedules";
    };
    document.title = `${nameOf(one)} · gablework`;
    return [
      el("div", { class: "sheet-head" }, el("h1", {}, nameOf(one)), scheduleMenu(one, () => this.load(), leave)),
      facts(
        { class: "facts-list" },
        ["State", chip(one.state)],
        ["Times", el("code", {}, one.cron), ` in ${zone}`],
        ["Next times", one.state === "paused" ? "none while it is paused" : el("ol", {}, ...next)],
        one.waiting === undefined ? null : ["Waits for its job to end", clockWords(one.waiting, zone)],
        ["Up to now", countWords(one.counts) || "nothing yet"],
        ["Makes", processWords(one)],
        files.length === 0 ? null : ["Files", el("ul", {}, ...files.map((file) => el("li", {}, file)))],
      ),
      section(
        "runs-title",
        "What happened",
        runs.length === 0
          ? nothing(this.offset > 0 ? "Nothing on this page." : "Nothing yet: no time has come since the schedule was made.")
          : table("What happened", runColumns(zone), runs),
        pager(page, ["schedules", this.id]),
      ),
      rawText("request-title", "The request of each job", JSON.stringify(inputs, null, 2)),
    ];
  }
}

function runColumns(zone: string): Column<ScheduleRun>[] {
  const link = ({ jobID }: ScheduleRun): Child => (jobID === undefined ? null : el("a", { href: hashOf(["jobs", jobID]) }, `Job ${jobID.slice(0, 8)}`));
  return [
    { head: "Time", kind: "clock", cell: (run) => [clockWords(run.slot ?? run.at, zone), sub(slotWords(run))] },
    { head: "Outcome", cell: (run) => [outcomeChip(run), sub(run.message), el("span", { class: "only-narrow" }, " ", link(run))] },
    { head: "Job", kind: "only-wide", cell: (run) => link(run) ?? "–" },
  ];
}

const pathOf = (id: string): string => `schedules/${encodeURIComponent(id)}`;

const nameOf = (one: Schedule): string => one.title ?? `Schedule ${one.scheduleID.slice(0, 8)}`;

const nextWords = ({ nextTimes: [next], timeZone }: Schedule): string => (next === undefined ? "–" : clockWords(next, timeZone));

const outcomeChip = ({ outcome }: ScheduleRun): HTMLElement => chip(outcome, outcomeWords(outcome));
