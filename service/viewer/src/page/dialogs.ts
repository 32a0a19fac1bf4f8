/** Dialogs of the page: questions before something is lost, and forms. */

import { button, el } from "./elements";
import { asProblem, report } from "./notices";
import "./dialogs.css";

/** An open dialog. */
export interface Opened {
  readonly element: HTMLDialogElement;
  close(): void;
}

let number = 0;

/**
 * Open a modal dialog. Escape and another address close it; the focus goes back to where it was.
 *
 * @param title Its heading.
 * @param content Its content.
 */
export function openDialog(title: string, content: (Node | null)[]): Opened {
  const id = `dialog-${(number += 1)}`;
  const element = el("dialog", { class: "dialog", "aria-labelledby": id }, el("h2", { id }, title), ...content);
  const before = document.activeElement;
  const close = (): void => element.close();
  // another page is shown, for example the one before
  window.addEventListener("hashchange", close);
  element.addEventListener("close", () => {
    window.removeEventListener("hashchange", close);
    element.remove();
    if (before instanceof HTMLElement && before.isConnected) before.focus();
  });
  document.body.append(element);
  element.showModal();
  return { element, close };
}

/** What a form does; may return what is done once it is closed. */
export type Act = () => Promise<void | (() => void)>;

/** A form with a button that sends it and one that leaves it. */
export interface SentForm {
  content: (Node | null)[];
  /** The words on the button that sends it. */
  send: string;
  /** What it does; the form shows its failure and stays. */
  act: Act;
}

/**
 * A form that is sent at most once at a time.
 *
 * @param leave Leaves it.
 * @param close Closes it after it was sent, or if the page asks for a key, in a dialog of its own.
 */
export function sentForm({ content, send, act }: SentForm, leave: HTMLElement, close: () => void, kind = "primary"): HTMLFormElement {
  const note = el("div");
  const go = el("button", { type: "submit", class: kind }, send);
  const perform = async (): Promise<void> => {
    if (go.getAttribute("aria-disabled") === "true") return;
    go.setAttribute("aria-disabled", "true"); // not `disabled`: it keeps the focus
    note.replaceChildren();
    try {
      const afterwards = await act();
      close();
      afterwards?.();
    } catch (error) {
      if (asProblem(error).status === 401) close();
      report(note, error);
    } finally {
      go.removeAttribute("aria-disabled");
    }
  };
  const form = el("form", { novalidate: true }, ...content, note, el("div", { class: "actions" }, leave, go));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    void perform();
  });
  return form;
}

/** Open a form in a dialog. */
export function openForm(title: string, form: SentForm): Opened {
  const no = button("Cancel", () => opened.close(), { class: "quiet" });
  const opened = openDialog(title, [sentForm(form, no, () => opened.close())]);
  return opened;
}

/** Ask before something is done that cannot be taken back. */
export function ask(title: string, text: string, form: Omit<SentForm, "content">): void {
  const no = button("No, go back", () => opened.close(), { class: "quiet", autofocus: true });
  const opened = openDialog(title, [sentForm({ ...form, content: [el("p", {}, text)] }, no, () => opened.close(), "danger")]);
}
