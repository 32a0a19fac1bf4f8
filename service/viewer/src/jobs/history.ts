/** All jobs: searched, filtered, page by page. */

import { isOver } from "../api/requests";
import type { StatusInfo } from "../api/types";
import { hashOf, partsOf, type Address } from "../page/address";
import { el } from "../page/elements";
import { choice, field, searchForm } from "../page/form_fields";
import { sheet } from "../page/sheet";
import { chip, type Column } from "../page/tables";
import { JOBS_CHANGED, type View } from "../page/view";
import { WatchedList, type Answer } from "../page/watched_list";
import { counted } from "../words/numbers";
import { jobMenu } from "./job_actions";
import { durationWords, PROCESS_WORDS, processWords, resultWords, STATUS_WORDS, statusWords, titleOf, whenWords } from "./job_words";

const PAUSE_MS = 300; // in typing, before the search begins

export const showHistory = (place: HTMLElement): View => new History(place);

class History extends WatchedList<StatusInfo> {
  protected readonly columns: Column<StatusInfo>[] = [
    { head: "Job", cell: (job) => nameCell(job) },
    {
      head: "Status",
      cell: (job) => [
        chip(job.status, statusWords(job)),
        job.keep === true ? el("span", { class: "sub", title: "Not removed by age or size" }, "kept") : null,
      ],
    },
    { head: "Result", kind: "only-wide", cell: resultWords },
    {
      head: "Created",
      kind: "only-wide when",
      cell: whenWords,
      title: ({ created }) => (created === undefined ? undefined : new Date(created).toLocaleString()),
    },
    { head: "Took", kind: "only-wide figure", cell: durationWords },
    { head: "Actions", kind: "acts", cell: (job) => jobMenu(job) },
  ];
  private readonly changed = (): void => void this.load(false);
  private typing: number | undefined;
  private readonly words = el("input", { type: "search", id: "history-words", maxlength: 200, autocomplete: "off" });
  private readonly status = choice("history-status", { "": "any", ...STATUS_WORDS });
  private readonly process = choice("history-process", { "": "any", ...PROCESS_WORDS });
  protected readonly empty = "No jobs yet. Drop a tile to make the first one.";
  protected readonly filters = { q: this.words, status: this.status, processID: this.process, scheduleID: null };
  private readonly tally = el("p", { class: "hint" });
  private readonly only = el("div");

  constructor(place: HTMLElement) {
    super({ name: "Jobs", noun: "job", path: "jobs", member: "jobs", words: ["jobs"], refreshMs: 4000 });
    document.addEventListener(JOBS_CHANGED, this.changed);
    this.words.addEventListener("input", () => {
      clearTimeout(this.typing);
      this.typing = window.setTimeout(() => this.search(), PAUSE_MS);
    });
    const form = searchForm(
      "Jobs",
      () => this.search(),
      field("Search in title, id and process", this.words),
      field("Status", this.status),
      field("Process", this.process),
    );
    place.replaceChildren(sheet("Jobs", [this.tally], form, this.only, this.note, this.frame, this.pages));
  }

  override follow(address: Address): void {
    super.follow(address);
    this.only.replaceChildren(...this.ofSchedule());
  }

  override leave(): void {
    clearTimeout(this.typing);
    document.removeEventListener(JOBS_CHANGED, this.changed);
    super.leave();
  }

  /** Show what the form asks for, from the first page. */
  private search(): void {
    clearTimeout(this.typing);
    const hash = this.asked();
    if (hash === location.hash) return;
    history.replaceState(null, "", hash); // a search in many letters is one step back
    this.follow(partsOf(hash));
  }

  protected override summary({ numberMatched = 0 }: Answer): string {
    this.tally.textContent = numberMatched === 0 ? "" : counted(numberMatched, "job");
    return counted(numberMatched, "job");
  }

  /** The filter that no field shows. */
  private ofSchedule(): HTMLElement[] {
    const id = this.query["scheduleID"] ?? "";
    if (id === "") return [];
    const schedule = el("a", { href: hashOf(["schedules", id]) }, `schedule ${id.slice(0, 8)}`);
    const all = el("a", { href: hashOf(["jobs"], { ...this.query, scheduleID: "", offset: "" }) }, "All jobs");
    return [el("p", {}, "Only jobs of ", schedule, ". ", all)];
  }

  protected mayChange({ status }: StatusInfo): boolean {
    return !isOver(status);
  }
}

function nameCell(job: StatusInfo): (HTMLElement | null)[] {
  const kind = [processWords(job), job.scheduleID === undefined ? "" : "scheduled"].filter(Boolean).join(" · ");
  const narrow = [whenWords(job), durationWords(job), resultWords(job)].filter(Boolean).join(" · ");
  return [
    el("a", { href: hashOf(["jobs", job.jobID]) }, titleOf(job)),
    el("span", { class: "sub" }, kind, el("span", { class: "only-narrow" }, ` · ${narrow}`)),
  ];
}
