/** Schedules: the list, and one of them with its next times and its runs. */

import { getJson, request, sendJson } from "../api/requests";
import type { Schedule, ScheduleRun, StatusInfo } from "../api/types";
import { PROCESS_WORDS } from "../jobs/job_words";
import { actionMenu, type Item } from "../page/action_menu";
import { hashOf, type Address } from "../page/address";
import { ask, openForm } from "../page/dialogs";
import { el } from "../page/elements";
import { announce } from "../page/notices";
import { offsetOf, pager } from "../page/paging";
import { fact, nothing, table } from "../page/tables";
import type { Hooks, View } from "../page/view";
import { Watching } from "../page/watching";
import { ago } from "../words/numbers";
import { showNewSchedule, TimeFields } from "./schedule_form";
import { clockWords, countWords, OUTCOME_WORDS, slotWords, tileLines } from "./schedules";
import "../page/pages.css";

const SIZE = 25;
const REFRESH_MS = 10_000;

export function showSchedules(place: HTMLElement, address: Address, hooks: Hooks): View {
  const [id] = address.rest;
  if (id === "new") return showNewSchedule(place, address, hooks);
  const view = id === undefined ? new ScheduleList(place, hooks) : new ScheduleView(place, hooks, id);
  view.follow(address);
  return view;
}

/** A view of schedules. */
abstract class Schedules extends Watching implements View {
  protected offset = 0;

  constructor(hooks: Hooks) {
    super(hooks, REFRESH_MS);
  }

  follow({ query }: Address): void {
    this.offset = offsetOf(query.get("offset"));
    void this.load();
  }

  /** What can be done with a schedule. */
  protected items(one: Schedule): Item[] {
    const path = pathOf(one.scheduleID);
    const paused = one.state === "paused";
    return [
      { label: "Run now", act: () => this.runNow(one) },
      { label: paused ? "Resume" : "Pause", act: () => this.change(one, { paused: !paused }, paused ? "It is resumed." : "It is paused.") },
      { label: "Change the times…", act: () => this.edit(one) },
      { label: "Its jobs", href: hashOf(["jobs"], { scheduleID: one.scheduleID }) },
      {
        label: "Remove…",
        act: () =>
          ask({
            title: "Remove the schedule?",
            text: `“${nameOf(one)}” runs no more, and the history of its times is deleted. Its jobs stay.`,
            yes: "Remove it",
            act: async () => {
              await request(path, { method: "DELETE" });
              announce("The schedule is removed.");
              this.removed();
            },
            onProblem: this.hooks.onProblem,
          }),
      },
    ];
  }

  protected removed(): void {
    void this.load();
  }

  private async runNow(one: Schedule): Promise<void> {
    const response = await request(`${pathOf(one.scheduleID)}/run`, { method: "POST" });
    const { jobID } = (await response.json()) as StatusInfo;
    announce("The job is submitted.");
    this.hooks.onChange();
    location.hash = hashOf(["jobs", jobID]);
  }

  private async change(one: Schedule, changes: Record<string, unknown>, words: string): Promise<void> {
    // a change that someone else made meanwhile is not overwritten
    await sendJson("PATCH", pathOf(one.scheduleID), changes, { "If-Match": `"${one.version}"` });
    announce(words);
    await this.load();
  }

  private edit(one: Schedule): void {
    const times = new TimeFields(one);
    openForm({
      title: "Change the times",
      content: times.elements,
      send: "Save",
      act: () => this.change(one, times.value(), "The schedule is changed."),
      onProblem: this.hooks.onProblem,
    });
  }
}

class ScheduleList extends Schedules {
  private readonly frame = el("div");
  private readonly pages = el("div");
  private shown = "";

  constructor(place: HTMLElement, hooks: Hooks) {
    super(hooks);
    document.title = "Schedules · gablework";
    place.replaceChildren(
      el(
        "div",
        { class: "sheet" },
        el("div", { class: "sheet-head" }, el("h1", {}, "Schedules"), el("a", { class: "button", href: "#/schedules/new" }, "New schedule…")),
        el("p", { class: "hint" }, "Jobs that the service repeats by itself at fixed times."),
        this.note,
        this.frame,
        this.pages,
      ),
    );
  }

  protected async read(signal: AbortSignal): Promise<boolean> {
    const answer = await getJson<{ schedules: Schedule[]; links: { rel?: string }[] }>(`schedules?limit=${SIZE}&offset=${this.offset}`, { signal });
    const state = JSON.stringify(answer);
    if (signal.aborted || state === this.shown || this.frame.querySelector("details[open]") !== null) return true;
    this.shown = state;
    const focused = this.frame.contains(document.activeElement) ? document.activeElement?.getAttribute("href") : null;
    const rows = answer.schedules.map((one) => this.row(one));
    this.frame.replaceChildren(
      rows.length === 0
        ? nothing("No schedules yet. Make one from a job that went well: Actions, Repeat on a schedule.")
        : table("Schedules", ["Schedule", "State", ["Next time", "only-wide"], ["Last time", "only-wide"], ["Actions", "acts"]], rows),
    );
    if (focused != null) this.frame.querySelector<HTMLAnchorElement>(`a[href="${CSS.escape(focused)}"]`)?.focus();
    const hasNext = answer.links.some(({ rel }) => rel === "next");
    const page = { offset: this.offset, size: SIZE, shown: rows.length, total: null, hasNext };
    this.pages.replaceChildren(pager(page, (to) => hashOf(["schedules"], { offset: to === 0 ? "" : String(to) })));
    return true;
  }

  private row(one: Schedule): HTMLElement {
    const [next] = one.nextTimes;
    const last = one.lastRun;
    const nextWords = next === undefined ? "–" : clockWords(next, one.timeZone);
    return el(
      "tr",
      {},
      el(
        "th",
        { scope: "row" },
        el("a", { href: hashOf(["schedules", one.scheduleID]) }, nameOf(one)),
        el("span", { class: "sub" }, `${one.cron} · ${one.timeZone} · ${PROCESS_WORDS[one.processID] ?? one.processID}`),
        el("span", { class: "sub only-narrow" }, `next ${nextWords}`),
      ),
      el("td", {}, stateChip(one)),
      el("td", { class: "only-wide" }, nextWords),
      el("td", { class: "only-wide" }, last === undefined ? "–" : el("span", {}, outcomeChip(last), ` ${ago(new Date(last.at), new Date())}`)),
      el("td", { class: "acts" }, actionMenu(nameOf(one), () => this.items(one), this.hooks.onProblem)),
    );
  }
}

class ScheduleView extends Schedules {
  private shown = "";
  private readonly content = el("div", {}, el("p", { class: "loading" }, "Loading…"));

  constructor(
    place: HTMLElement,
    hooks: Hooks,
    private readonly id: string,
  ) {
    super(hooks);
    document.title = "Schedule · gablework";
    place.replaceChildren(el("div", { class: "sheet" }, this.content, this.note));
  }

  protected override removed(): void {
    location.hash = "#/schedules";
  }

  protected async read(signal: AbortSignal): Promise<boolean> {
    const path = pathOf(this.id);
    try {
      const [one, { runs, links }] = await Promise.all([
        getJson<Schedule>(path, { signal }),
        getJson<{ runs: ScheduleRun[]; links: { rel?: string }[] }>(`${path}/runs?limit=${SIZE}&offset=${this.offset}`, { signal }),
      ]);
      const state = JSON.stringify([one, runs]);
      if (signal.aborted || state === this.shown || this.content.querySelector("details[open]") !== null) return true;
      this.shown = state;
      document.title = `${nameOf(one)} · gablework`;
      this.content.replaceChildren(...this.parts(one, runs, links.some(({ rel }) => rel === "next")));
      return true;
    } catch (error) {
      if (this.shown === "") this.content.replaceChildren(backLink());
      throw error;
    }
  }

  private parts(one: Schedule, runs: ScheduleRun[], hasNext: boolean): HTMLElement[] {
    const inputs = one.execute?.inputs ?? {};
    const files = tileLines(inputs).split("\n").filter((line) => line !== "");
    const page = { offset: this.offset, size: SIZE, shown: runs.length, total: null, hasNext };
    return [
      el("div", { class: "sheet-head" }, el("h1", {}, nameOf(one)), actionMenu(nameOf(one), () => this.items(one), this.hooks.onProblem)),
      backLink(),
      el(
        "dl",
        { class: "facts-list" },
        ...fact("State", stateChip(one)),
        ...fact("Times", el("code", {}, one.cron), ` in ${one.timeZone}`),
        ...fact("Next times", one.state === "paused" ? "none while it is paused" : el("ol", {}, ...one.nextTimes.map((time) => el("li", {}, clockWords(time, one.timeZone))))),
        ...(one.waiting === undefined ? [] : fact("Waits for its job to end", clockWords(one.waiting, one.timeZone))),
        ...fact("Up to now", countWords(one.counts) || "nothing yet"),
        ...fact("Makes", PROCESS_WORDS[one.processID] ?? one.processID),
        ...(files.length === 0 ? [] : fact("Files", el("ul", {}, ...files.map((file) => el("li", {}, file))))),
      ),
      el(
        "section",
        { "aria-labelledby": "runs-title" },
        el("h2", { id: "runs-title" }, "What happened"),
        runs.length === 0
          ? nothing(this.offset > 0 ? "Nothing on this page." : "Nothing yet: no time has come since the schedule was made.")
          : table("What happened", ["Time", "Outcome", ["Job", "only-wide"]], runs.map((run) => runRow(run, one.timeZone))),
        pager(page, (to) => hashOf(["schedules", this.id], { offset: to === 0 ? "" : String(to) })),
      ),
      el(
        "section",
        {},
        el("h2", { id: "request-title" }, "The request of each job"),
        el("pre", { class: "raw", tabindex: 0, role: "region", "aria-labelledby": "request-title" }, JSON.stringify(inputs, null, 2)),
      ),
    ];
  }
}

function runRow(run: ScheduleRun, zone: string): HTMLElement {
  const more = slotWords(run);
  const link = run.jobID === undefined ? null : el("a", { href: hashOf(["jobs", run.jobID]) }, `Job ${run.jobID.slice(0, 8)}`);
  return el(
    "tr",
    {},
    el("th", { scope: "row", class: "clock" }, clockWords(run.slot ?? run.at, zone), more === "" ? null : el("span", { class: "sub" }, more)),
    el("td", {}, outcomeChip(run), run.message === "" ? null : el("span", { class: "sub" }, run.message), link === null ? null : el("span", { class: "only-narrow" }, " ", link.cloneNode(true))),
    el("td", { class: "only-wide" }, link ?? "–"),
  );
}

const pathOf = (id: string): string => `schedules/${encodeURIComponent(id)}`;

const nameOf = (one: Schedule): string => one.title ?? `Schedule ${one.scheduleID.slice(0, 8)}`;

const backLink = (): HTMLElement => el("p", {}, el("a", { href: "#/schedules" }, "← All schedules"));

const stateChip = ({ state }: Schedule): HTMLElement => el("span", { class: `chip chip-${state}` }, state);

const outcomeChip = ({ outcome }: ScheduleRun): HTMLElement => el("span", { class: `chip chip-${outcome}` }, OUTCOME_WORDS[outcome] ?? outcome);
