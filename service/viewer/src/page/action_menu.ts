import { button, el } from "./elements";
import { asProblem, problemNotice } from "./notices";
import "./action_menu.css";

/** An entry of a menu: something to do, or somewhere to go. */
export type Item = { label: string; act: () => Promise<void> | void } | { label: string; href: string };

/** What opens below a button; Escape, a click elsewhere and leaving it by the keyboard close it. */
export function dropDown(opener: HTMLElement, content: HTMLElement, kind = ""): HTMLDetailsElement {
  content.classList.add("menu-list");
  const menu = el("details", { class: `menu ${kind}` }, opener, content);
  const elsewhere = (event: Event): void => {
    if (!menu.contains(event.target as Node)) menu.open = false;
  };
  menu.addEventListener("toggle", () => {
    if (menu.open) document.addEventListener("pointerdown", elsewhere);
    else document.removeEventListener("pointerdown", elsewhere);
  });
  menu.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || !menu.open) return;
    menu.open = false;
    opener.focus();
  });
  menu.addEventListener("focusout", ({ relatedTarget }) => {
    if (relatedTarget !== null && !menu.contains(relatedTarget as Node)) menu.open = false;
  });
  return menu;
}

/**
 * A button that opens a menu of actions.
 *
 * @param name What the actions are for, for screen readers.
 * @param items The entries at the time at which it is opened.
 */
export function actionMenu(name: string, items: () => Item[]): HTMLElement {
  const list = el("div");
  const opener = el("summary", { class: "button quiet", "aria-label": `Actions for ${name}` }, el("span", { class: "actions-word" }, "Actions"), el("span", { class: "actions-dots" }, "⋯"));
  const menu = dropDown(opener, list, "actions-menu");
  const close = (): void => {
    menu.open = false;
  };
  const perform = async (act: () => Promise<void> | void): Promise<void> => {
    close();
    opener.focus();
    try {
      await act();
    } catch (error) {
      menu.open = true;
      fill(problemNotice(asProblem(error)));
    }
  };
  const fill = (note: HTMLElement | null = null): void => {
    const entries = items().map((item) =>
      "href" in item
        ? el("a", { class: "button quiet", href: item.href, onclick: close }, item.label)
        : button(item.label, () => void perform(item.act), { class: "quiet" }),
    );
    list.replaceChildren(...entries, ...(note === null ? [] : [note]));
  };
  opener.addEventListener("click", () => {
    if (!menu.open) fill(); // it opens after the click
  });
  return menu;
}
