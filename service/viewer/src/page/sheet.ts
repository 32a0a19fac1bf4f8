import { el, type Child } from "./elements";
import "./pages.css";

/** A page of text and tables: its title, which the browser shows, too, what stands beside it, and the rest below. */
export function sheet(title: string, beside: Child[], ...content: Child[]): HTMLElement {
  document.title = `${title} · gablework`;
  return el("div", { class: "sheet" }, el("div", { class: "sheet-head" }, el("h1", {}, title), ...beside), ...content);
}

/** A part of a sheet with its heading. */
export function section(id: string, title: string, ...content: Child[]): HTMLElement {
  return el("section", { "aria-labelledby": id }, el("h2", { id }, title), ...content);
}

/** A text as it was sent. */
export function rawText(id: string, title: string, text: string): HTMLElement {
  const region = el("pre", { class: "raw", tabindex: 0, role: "region", "aria-labelledby": id }, text);
  return el("section", {}, el("h2", { id }, title), region);
}

/** The way back to a list. */
export const backLink = (href: string, words: string): HTMLElement => el("p", {}, el("a", { href }, `← ${words}`));
