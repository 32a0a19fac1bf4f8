import type { Problem } from "../api/requests";
import { el } from "./elements";
import { asProblem, problemNotice } from "./notices";
import "./action_menu.css";

/** An entry of a menu: something to do, or somewhere to go. */
export type Item = { label: string; act: () => Promise<void> | void } | { label: string; href: string };

/**
 * A button that opens a menu of actions; Escape, a click elsewhere and leaving it by the keyboard close it.
 *
 * @param name What the actions are for, for screen readers.
 * @param items The entries at the time at which it is opened.
 * @param onProblem Gets what went wrong; the menu shows it, too.
 */
export function actionMenu(name: string, items: () => Item[], onProblem: (problem: Problem) => void): HTMLElement {
  const list = el("div", { class: "menu-list" });
  const opener = el("summary", { class: "button quiet", "aria-label": `Actions for ${name}` }, el("span", { class: "actions-word" }, "Actions"), el("span", { class: "actions-dots" }, "⋯"));
  const menu = el("details", { class: "menu actions-menu" }, opener, list);
  const close = (): void => {
    menu.open = false;
  };
  const perform = async (act: () => Promise<void> | void): Promise<void> => {
    close();
    opener.focus();
    try {
      await act();
    } catch (error) {
      const problem = asProblem(error);
      onProblem(problem);
      menu.open = true;
      fill(problemNotice(problem));
    }
  };
  const fill = (note: HTMLElement | null = null): void => {
    const entries = items().map((item) =>
      "href" in item
        ? el("a", { class: "button quiet", href: item.href, onclick: close }, item.label)
        : el("button", { type: "button", class: "quiet", onclick: () => void perform(item.act) }, item.label),
    );
    list.replaceChildren(...entries, ...(note === null ? [] : [note]));
  };
  const elsewhere = (event: Event): void => {
    if (!menu.contains(event.target as Node)) close();
  };
  opener.addEventListener("click", () => {
    if (!menu.open) fill(); // it opens after the click
  });
  menu.addEventListener("toggle", () => {
    if (menu.open) document.addEventListener("pointerdown", elsewhere);
    else document.removeEventListener("pointerdown", elsewhere);
  });
  menu.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || !menu.open) return;
    close();
    opener.focus();
  });
  menu.addEventListener("focusout", ({ relatedTarget }) => {
    if (relatedTarget !== null && !menu.contains(relatedTarget as Node)) close();
  });
  return menu;
}
