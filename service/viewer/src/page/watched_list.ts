import { getJson } from "../api/requests";
import { hashOf, type Address } from "./address";
import { el, refill } from "./elements";
import { announce } from "./notices";
import { offsetOf, pager } from "./paging";
import { nothing, table, type Column } from "./tables";
import type { View } from "./view";
import { Watching } from "./watching";

/** Entries of a page. */
export const SIZE = 25;

/** What the service answers beside the entries of a page. */
export interface Answer {
  numberMatched?: number;
  links: { rel?: string }[];
}

/** A list and its places. */
export interface ListKind {
  /** For screen readers. */
  name: string;
  /** What an entry is. */
  noun: string;
  /** At the service. */
  path: string;
  /** The member of an answer that holds the entries. */
  member: string;
  /** Its address on the page. */
  words: readonly string[];
  refreshMs: number;
}

export const hasNext = ({ links }: Answer): boolean => links.some(({ rel }) => rel === "next");

/** A list of the service, filtered and page by page, that is read again while one of its entries may change. */
export abstract class WatchedList<T> extends Watching implements View {
  protected query: Record<string, string> = {};
  protected readonly frame = el("div");
  protected readonly pages = el("div");
  protected abstract readonly columns: readonly Column<T>[];
  /** The members of an address that filter it, likewise at the service, with their controls; null for none. */
  protected abstract readonly filters: Readonly<Record<string, HTMLInputElement | HTMLSelectElement | null>>;
  private shown = "";

  constructor(private readonly kind: ListKind) {
    super(kind.refreshMs);
  }

  follow({ query }: Address): void {
    this.query = Object.fromEntries(query);
    for (const [name, control] of Object.entries(this.filters)) {
      // what is being typed is newer than the address
      if (control !== null && (control.type !== "search" || document.activeElement !== control)) control.value = query.get(name) ?? "";
    }
    this.refresh();
  }

  /** Read it, and draw it even if it is the same. */
  refresh(): void {
    this.shown = "";
    void this.load();
  }

  /** The address of the list that the controls ask for, from its first page. */
  protected asked(): string {
    const given = Object.entries(this.filters).map(([name, control]) => [name, control?.value.trim() ?? this.query[name] ?? ""]);
    return hashOf(this.kind.words, Object.fromEntries(given));
  }

  /** Words in place of a list without entries. */
  protected abstract readonly empty: string;

  /** Whether an entry may change by itself. */
  protected abstract mayChange(entry: T): boolean;

  /** Called with each answer; returns its summary for screen readers. */
  protected summary(_answer: Answer): string {
    return "";
  }

  protected async read(signal: AbortSignal, isAsked: boolean): Promise<boolean> {
    const { path, member } = this.kind;
    const offset = offsetOf(this.query["offset"]);
    const given = Object.keys(this.filters).map((name) => [name, this.query[name] ?? ""]).filter(([, value]) => value !== "");
    const asked = new URLSearchParams([["limit", String(SIZE)], ["offset", String(offset)], ...given]);
    const answer = await getJson<Answer>(`${path}?${asked}`, { signal });
    if (signal.aborted) return false;
    const entries = (answer as unknown as Record<string, T[]>)[member];
    const state = JSON.stringify(answer);
    // an open menu is not closed by a refresh
    if (state !== this.shown && this.frame.querySelector("details[open]") === null) {
      this.shown = state;
      this.draw(answer, entries, offset, given.length > 0);
    }
    const words = this.summary(answer);
    if (isAsked && words !== "") announce(words);
    return entries.some((entry) => this.mayChange(entry));
  }

  private draw(answer: Answer, entries: readonly T[], offset: number, isFiltered: boolean): void {
    const { name, noun, words } = this.kind;
    if (entries.length > 0) refill(this.frame, table(name, this.columns, entries));
    else if (offset > 0) refill(this.frame, nothing("There is nothing on this page. ", el("a", { href: hashOf(words, { ...this.query, offset: "" }) }, "First page")));
    else if (isFiltered) refill(this.frame, nothing(`No ${noun} fits. `, el("a", { href: hashOf(words) }, `Show all ${noun}s`)));
    else refill(this.frame, nothing(this.empty));
    const page = { offset, size: SIZE, shown: entries.length, total: answer.numberMatched ?? null, hasNext: hasNext(answer) };
    this.pages.replaceChildren(pager(page, words, this.query));
  }
}
