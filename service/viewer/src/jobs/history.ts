/** All jobs: searched, filtered, page by page. */

import { getJson, isOver } from "../api/requests";
import type { StatusInfo } from "../api/types";
import { hashOf, partsOf, type Address } from "../page/address";
import { el } from "../page/elements";
import { choice, field } from "../page/form_fields";
import { announce } from "../page/notices";
import { offsetOf, pager } from "../page/paging";
import { nothing, table } from "../page/tables";
import type { Hooks, View } from "../page/view";
import { Watching } from "../page/watching";
import { ago, counted } from "../words/numbers";
import { jobMenu } from "./job_actions";
import { durationWords, PROCESS_WORDS, resultWords, STATUS_WORDS, statusWords, titleOf } from "./job_words";
import "../page/pages.css";

const SIZE = 25;
const REFRESH_MS = 4000;
const HEADS = ["Job", "Status", ["Result", "only-wide"], ["Created", "only-wide"], ["Took", "only-wide"], ["Actions", "acts"]] as const;
const PAUSE_MS = 300; // in typing, before the search begins

interface Answer {
  jobs: StatusInfo[];
  numberMatched: number;
  links: { rel?: string }[];
}

export function showHistory(place: HTMLElement, address: Address, hooks: Hooks): View {
  const view = new History(place, hooks);
  view.follow(address);
  return view;
}

class History extends Watching implements View {
  private query: Record<string, string> = {};
  private typing: number | undefined;
  private shown = "";
  private readonly words = el("input", { type: "search", id: "history-words", maxlength: 200, autocomplete: "off" });
  private readonly status = choice("history-status", { "": "any", ...STATUS_WORDS });
  private readonly process = choice("history-process", { "": "any", ...PROCESS_WORDS });
  private readonly tally = el("p", { class: "hint" });
  private readonly only = el("div");
  private readonly frame = el("div");
  private readonly pages = el("div");

  constructor(place: HTMLElement, hooks: Hooks) {
    super(hooks, REFRESH_MS);
    document.title = "Jobs · gablework";
    const form = el(
      "form",
      { class: "search", role: "search", "aria-label": "Jobs" },
      field("Search in title, id and process", this.words),
      field("Status", this.status),
      field("Process", this.process),
    );
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.search();
    });
    this.words.addEventListener("input", () => {
      clearTimeout(this.typing);
      this.typing = window.setTimeout(() => this.search(), PAUSE_MS);
    });
    for (const control of [this.status, this.process]) control.addEventListener("change", () => this.search());
    place.replaceChildren(
      el("div", { class: "sheet" }, el("div", { class: "sheet-head" }, el("h1", {}, "Jobs"), this.tally), form, this.only, this.note, this.frame, this.pages),
    );
  }

  follow({ query }: Address): void {
    this.query = Object.fromEntries(query);
    // what is being typed is newer than the address
    if (document.activeElement !== this.words) this.words.value = query.get("q") ?? "";
    this.status.value = query.get("status") ?? "";
    this.process.value = query.get("processID") ?? "";
    this.shown = "";
    void this.load();
  }

  override leave(): void {
    clearTimeout(this.typing);
    super.leave();
  }

  /** Show what the form asks for, from the first page. */
  private search(): void {
    clearTimeout(this.typing);
    const query = { q: this.words.value.trim(), status: this.status.value, processID: this.process.value };
    const hash = hashOf(["jobs"], { ...query, scheduleID: this.query["scheduleID"] ?? "" });
    if (hash === location.hash) return;
    history.replaceState(null, "", hash); // a search in many letters is one step back
    this.follow(partsOf(hash));
  }

  protected async read(signal: AbortSignal, isAsked: boolean): Promise<boolean> {
    const offset = offsetOf(this.query["offset"] ?? null);
    const asked = new URLSearchParams({ limit: String(SIZE), offset: String(offset) });
    for (const name of ["q", "status", "processID", "scheduleID"]) {
      const value = this.query[name] ?? "";
      if (value !== "") asked.set(name, value);
    }
    const answer = await getJson<Answer>(`jobs?${asked}`, { signal });
    if (signal.aborted) return false;
    this.draw(answer, offset);
    if (isAsked) announce(counted(answer.numberMatched, "job"));
    return answer.jobs.some(({ status }) => !isOver(status));
  }

  private draw({ jobs, numberMatched, links }: Answer, offset: number): void {
    const state = JSON.stringify([jobs, numberMatched]);
    // an open menu is not closed by a refresh
    if (state === this.shown || this.frame.querySelector("details[open]") !== null) return;
    this.shown = state;
    const isSearch = ["q", "status", "processID", "scheduleID"].some((name) => (this.query[name] ?? "") !== "");
    this.only.replaceChildren(...this.ofSchedule());
    this.tally.textContent = numberMatched === 0 ? "" : counted(numberMatched, "job");
    const now = new Date();
    const focused = this.frame.contains(document.activeElement) ? document.activeElement?.getAttribute("href") : null;
    const rows = jobs.map((job) => this.row(job, now));
    this.frame.replaceChildren(rows.length === 0 ? this.nothing(isSearch, offset) : table("Jobs", HEADS, rows));
    if (focused != null) this.frame.querySelector<HTMLAnchorElement>(`a[href="${CSS.escape(focused)}"]`)?.focus();
    const page = {
      offset,
      size: SIZE,
      shown: jobs.length,
      total: numberMatched,
      hasNext: links.some(({ rel }) => rel === "next"),
    };
    this.pages.replaceChildren(pager(page, (to) => hashOf(["jobs"], { ...this.query, offset: to === 0 ? "" : String(to) })));
  }

  /** The filter that no field shows. */
  private ofSchedule(): HTMLElement[] {
    const id = this.query["scheduleID"] ?? "";
    if (id === "") return [];
    const schedule = el("a", { href: hashOf(["schedules", id]) }, `schedule ${id.slice(0, 8)}`);
    return [el("p", {}, "Only jobs of ", schedule, ". ", el("a", { href: hashOf(["jobs"], { ...this.query, scheduleID: "", offset: "" }) }, "All jobs"))];
  }

  private nothing(isSearch: boolean, offset: number): HTMLElement {
    if (offset > 0) {
      return nothing("There are no jobs on this page. ", el("a", { href: hashOf(["jobs"], { ...this.query, offset: "" }) }, "First page"));
    }
    if (!isSearch) return nothing("No jobs yet. Drop a tile to make the first one.");
    return nothing("No job fits. ", el("a", { href: "#/jobs" }, "Show all jobs"));
  }

  private row(job: StatusInfo, now: Date): HTMLElement {
    const created = job.created === undefined ? null : new Date(job.created);
    const process = PROCESS_WORDS[job.processID ?? "reconstruct"] ?? job.processID ?? "";
    const result = resultWords(job);
    const when = created === null ? "" : ago(created, now);
    const took = durationWords(job, now);
    const sub = [process, job.scheduleID === undefined ? "" : "scheduled"].filter((part) => part !== "").join(" · ");
    const narrow = [when, took, result].filter((part) => part !== "").join(" · ");
    return el(
      "tr",
      {},
      el(
        "th",
        { scope: "row" },
        el("a", { href: hashOf(["jobs", job.jobID]) }, titleOf(job)),
        el("span", { class: "sub" }, sub, el("span", { class: "only-narrow" }, ` · ${narrow}`)),
      ),
      el(
        "td",
        {},
        el("span", { class: `chip chip-${job.status}` }, statusWords(job)),
        job.keep === true ? el("span", { class: "sub", title: "Not removed by age or size" }, "kept") : null,
      ),
      el("td", { class: "only-wide" }, result),
      el("td", { class: "only-wide when", title: created?.toLocaleString() ?? null }, when),
      el("td", { class: "only-wide figure" }, took),
      el("td", { class: "acts" }, jobMenu(job, { ...this.hooks, onChange: () => this.changed() })),
    );
  }

  private changed(): void {
    this.hooks.onChange();
    void this.load(false);
  }
}
