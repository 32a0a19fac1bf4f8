import { el } from "./elements";

/** The head of a column: its words, and the class of its cells, such as `only-wide`. */
export type Head = string | readonly [string, string];

/** A table in a frame. Its name is for screen readers. */
export function table(name: string, heads: readonly Head[], rows: readonly HTMLElement[]): HTMLElement {
  const cells = heads.map((head) => {
    const [words, kind] = typeof head === "string" ? [head, null] : head;
    return el("th", { scope: "col", class: kind }, words);
  });
  return el(
    "div",
    { class: "table-frame" },
    el("table", { class: "rows", "aria-label": name }, el("thead", {}, el("tr", {}, ...cells)), el("tbody", {}, ...rows)),
  );
}

/** The same frame around words in place of a table. */
export function nothing(...words: (Node | string | null)[]): HTMLElement {
  return el("div", { class: "table-frame" }, el("p", { class: "nothing" }, ...words));
}

/** A term and its value, for a list of facts. */
export function fact(name: string, ...value: (Node | string)[]): HTMLElement[] {
  return [el("dt", {}, name), el("dd", {}, ...value)];
}
