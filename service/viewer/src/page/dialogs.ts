/** Dialogs of the page: questions before something is lost, and forms. */

import { Problem } from "../api/requests";
import { el } from "./elements";
import { asProblem, problemNotice } from "./notices";
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
 * @param onClose Called once, however it is closed.
 */
export function openDialog(title: string, content: (Node | null)[], onClose: () => void = () => undefined): Opened {
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
    onClose();
  });
  document.body.append(element);
  element.showModal();
  return { element, close };
}

/** Does what a dialog is about; may return what is done once the dialog is closed. */
export type Act = () => Promise<void | (() => void)>;

/** A question whose answer cannot be taken back. */
export interface Question {
  title: string;
  text: string;
  /** The words on the button that does it. */
  yes: string;
  /** What is done on yes; the dialog shows its failure and stays open. */
  act: Act;
  onProblem?: (problem: Problem) => void;
}

/** Ask before something is done. */
export function ask({ title, text, yes, act, onProblem }: Question): void {
  const note = el("div");
  const go = el("button", { type: "button", class: "danger" }, yes);
  const no = el("button", { type: "button", class: "quiet", autofocus: true }, "No, go back");
  const { close } = openDialog(title, [el("p", {}, text), note, el("div", { class: "actions" }, no, go)]);
  no.addEventListener("click", close);
  go.addEventListener("click", () => void perform(go, note, act, close, onProblem));
}

/** A form in a dialog, with a button that sends it and one that leaves it. */
export interface DialogForm {
  title: string;
  content: (Node | null)[];
  send: string;
  /** Send the form; the dialog shows its failure and stays open. */
  act: Act;
  onProblem?: (problem: Problem) => void;
}

/** Open a form. */
export function openForm({ title, content, send, act, onProblem }: DialogForm): void {
  const note = el("div");
  const go = el("button", { type: "submit", class: "primary" }, send);
  const no = el("button", { type: "button", class: "quiet" }, "Cancel");
  const form = el("form", { novalidate: true }, ...content, note, el("div", { class: "actions" }, no, go));
  const { close } = openDialog(title, [form]);
  no.addEventListener("click", close);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    void perform(go, note, act, close, onProblem);
  });
}

async function perform(
  button: HTMLButtonElement,
  note: HTMLElement,
  act: Act,
  close: () => void,
  onProblem?: (problem: Problem) => void,
): Promise<void> {
  if (button.getAttribute("aria-disabled") === "true") return;
  button.setAttribute("aria-disabled", "true"); // not `disabled`: it keeps the focus
  note.replaceChildren();
  try {
    const afterwards = await act();
    close();
    afterwards?.();
  } catch (error) {
    const problem = asProblem(error);
    button.removeAttribute("aria-disabled");
    if (problem.status === 401) close(); // the page asks for a key, in a dialog of its own
    note.replaceChildren(problemNotice(problem));
    onProblem?.(problem);
  }
}
