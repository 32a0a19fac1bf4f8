import { el, type Child, type Properties } from "./elements";

/** A column of a table. */
export interface Column<T> {
  head: string;
  /** The class of its cells, such as `only-wide`. */
  kind?: string;
  /** What it shows of an entry. */
  cell: (entry: T) => Child | Child[];
  /** The same in full, where that is too long to be shown. */
  title?: (entry: T) => string | undefined;
}

/**
 * A table in a frame.
 *
 * @param name For screen readers.
 * @param row The attributes of the row of an entry.
 */
export function table<T>(name: string, columns: readonly Column<T>[], entries: readonly T[], row?: (entry: T) => Properties): HTMLElement {
  const properties = { class: "rows", "aria-label": name };
  return el("div", { class: "table-frame" }, bareTable(properties, columns, entries, row));
}

/** The same without a frame; the first cell of a row is its head. */
export function bareTable<T>(
  properties: Properties,
  columns: readonly Column<T>[],
  entries: readonly T[],
  row: (entry: T) => Properties = () => ({}),
): HTMLElement {
  const heads = columns.map(({ head, kind }) => el("th", { scope: "col", class: kind }, head));
  const rows = entries.map((entry) =>
    el("tr", row(entry), ...columns.map(({ kind, cell, title }, at) => {
      const isHead = at === 0;
      return el(isHead ? "th" : "td", { scope: isHead ? "row" : null, class: kind, title: title?.(entry) }, ...[cell(entry)].flat());
    })),
  );
  return el("table", properties, el("thead", {}, el("tr", {}, ...heads)), el("tbody", {}, ...rows));
}

/** A further line in a cell; null if it says nothing. */
export function sub(words: string | undefined, ...more: Child[]): HTMLElement | null {
  return words === undefined || words === "" ? null : el("span", { class: "sub" }, words, ...more);
}

/** A state in a colour of its own. */
export function chip(state: string, words = state): HTMLElement {
  return el("span", { class: `chip chip-${state}` }, words);
}

/** The same frame around words in place of a table. */
export function nothing(...words: Child[]): HTMLElement {
  return el("div", { class: "table-frame" }, el("p", { class: "nothing" }, ...words));
}

/** Terms and their values; null leaves one out. */
export function facts(properties: Properties, ...rows: (readonly [string, ...Child[]] | null)[]): HTMLElement {
  const known = rows.filter((row) => row !== null);
  return el("dl", properties, ...known.flatMap(([name, ...value]) => [el("dt", {}, name), el("dd", {}, ...value)]));
}
