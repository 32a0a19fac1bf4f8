import { count } from "../words/numbers";
import { hashOf } from "./address";
import { el } from "./elements";

/** `1 to 25 of 312`; without a total `1 to 25`. */
export function pageWords(offset: number, shown: number, total: number | null): string {
  if (shown === 0) return "";
  const range = shown === 1 ? count(offset + 1) : `${count(offset + 1)} to ${count(offset + shown)}`;
  return total === null ? range : `${range} of ${count(total)}`;
}

/** The offset in an address; 0 if it is none. */
export function offsetOf(text: string | null | undefined): number {
  const offset = Number(text ?? 0);
  return Number.isSafeInteger(offset) && offset > 0 ? offset : 0;
}

/** Which part of a list is shown. */
export interface Page {
  offset: number;
  size: number;
  shown: number;
  total: number | null;
  hasNext: boolean;
}

/** Links to the page before and the next one of the list at an address; hidden if there is one page. */
export function pager(page: Page, words: readonly string[], query: Readonly<Record<string, string>> = {}): HTMLElement {
  const { offset, size, shown, total, hasNext } = page;
  const address = (to: number): string => hashOf(words, { ...query, offset: to === 0 ? "" : String(to) });
  const step = (label: string, to: number, there: boolean): HTMLElement =>
    there
      ? el("a", { class: "button", href: address(to), rel: to < offset ? "prev" : "next" }, label)
      : el("span", { class: "button", "aria-disabled": "true" }, label);
  return el(
    "nav",
    { class: "pager", "aria-label": "Pages", hidden: offset === 0 && !hasNext },
    step("‹ Before", Math.max(0, offset - size), offset > 0),
    el("span", { class: "hint" }, pageWords(offset, shown, total)),
    step("Next ›", offset + size, hasNext),
  );
}
