import { el } from "./elements";

/** A control with its label above and a hint below. The control has an id. */
export function field(label: string, control: HTMLElement, hint?: string): HTMLElement {
  const hintId = `${control.id}-hint`;
  if (hint !== undefined) control.setAttribute("aria-describedby", hintId);
  return el(
    "div",
    { class: "field" },
    el("label", { for: control.id }, label),
    control,
    hint === undefined ? null : el("p", { class: "hint", id: hintId }, hint),
  );
}

/** A choice of words with their labels; the first is chosen if no other is. */
export function choice(id: string, options: Record<string, string>, chosen?: string): HTMLSelectElement {
  return el("select", { id }, ...Object.entries(options).map(([value, label]) => el("option", { value, selected: value === chosen }, label)));
}
