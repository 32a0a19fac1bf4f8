import type { SettingSchema } from "../api/types";
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

/** A control for a value, by its schema: a choice or a text; `more` are further words of a choice with their labels. */
export function controlOf(schema: SettingSchema, id: string, value: string, more: Record<string, string> = {}): HTMLInputElement | HTMLSelectElement {
  const words = schema.enum ?? (schema.type === "boolean" ? ["true", "false"] : null);
  if (words === null) return el("input", { type: "text", id, value, autocomplete: "off" });
  return choice(id, { ...more, ...Object.fromEntries(words.map((word) => [word, more[word] ?? word])) }, value);
}

/** The value of a text; a text that does not fit stays a text, and the service says what is wrong with it. */
export function valueOf(text: string, { type }: SettingSchema): unknown {
  const trimmed = text.trim();
  if (type === "boolean" && (trimmed === "true" || trimmed === "false")) return trimmed === "true";
  if (type === "array") return trimmed.split(",").map((part) => number(part.trim()));
  return type === "string" ? trimmed : number(trimmed);
}

/** A value as the text of a field. */
export const textOf = (value: unknown): string => (Array.isArray(value) ? value.join(", ") : String(value ?? ""));

function number(text: string): number | string {
  return text !== "" && Number.isFinite(Number(text)) ? Number(text) : text;
}

/** A form whose fields filter a list; it searches when one of them was changed. */
export function searchForm(name: string, search: () => void, ...fields: HTMLElement[]): HTMLFormElement {
  const sent = (event: Event): void => {
    event.preventDefault();
    search();
  };
  return el("form", { class: "search", role: "search", "aria-label": name, onchange: search, onsubmit: sent }, ...fields);
}

/** A set of checkboxes. */
export class Boxes {
  readonly element = el("div", { class: "boxes" });
  private boxes: HTMLInputElement[] = [];

  /** Offer these words with their labels; the chosen ones are checked. */
  offer(labels: Readonly<Record<string, string>>, chosen: readonly string[] = []): void {
    const words = Object.keys(labels);
    this.boxes = words.map((value) => el("input", { type: "checkbox", value, checked: chosen.includes(value) }));
    this.element.replaceChildren(...this.boxes.map((box) => el("label", {}, box, ` ${labels[box.value]}`)));
  }

  get chosen(): string[] {
    return this.boxes.filter(({ checked }) => checked).map(({ value }) => value);
  }

  /** Boxes that cannot be set at the moment. */
  disable(isOff: (value: string) => boolean): void {
    for (const box of this.boxes) box.disabled = isOff(box.value);
  }
}
