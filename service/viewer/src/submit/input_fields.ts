/** The fields of a process's inputs, made from its own description. */

import type { InputDescription } from "../api/types";
import { levelsOffered, levelWords, lodsInput } from "../models/levels_of_detail";
import { el } from "../page/elements";
import { Boxes, controlOf, field, textOf, valueOf } from "../page/form_fields";
import { TABLES } from "../words/tables";

/** The field of one input. */
export interface InputField {
  readonly element: HTMLElement;
  /** What is chosen or typed; null for nothing. */
  value(): unknown;
  /** What it holds at first. */
  readonly before: unknown;
  /** Bring that back. */
  reset(): void;
  /** Its boxes, if it offers several words at once. */
  readonly boxes?: Boxes;
}

export type InputFields = Map<string, InputField>;

/** Inputs that are files, that have a part of their own, or that are for operators. */
const ELSEWHERE = new Set(["tiles", "footprints", "guides", "settings", "priority"]);

/** Inputs that most jobs need, in this order; the others follow in the order of the process. */
const FIRST = ["crs", "allowOutsideAreaOfUse", "method", "preset", "lods", "methods", "message", "footprintsLayer", "publish", "title"];

/** Vertical units that are offered; a job may also have one by another name. */
const UNITS: Record<string, string> = { m: "metres", ft: "feet", "us-ft": "US survey feet" };

export const isFirst = (name: string): boolean => FIRST.includes(name);

/** The fields of all inputs of a process, filled with what is given, otherwise with what is usual. */
export function inputFields(inputs: Readonly<Record<string, InputDescription>>, given: Readonly<Record<string, unknown>> = {}): InputFields {
  const names = [...FIRST.filter((name) => name in inputs), ...Object.keys(inputs).filter((name) => !isFirst(name))];
  return new Map(names.filter((name) => !ELSEWHERE.has(name)).map((name) => [name, fieldOf(name, inputs[name], given[name])]));
}

/** The inputs whose fields hold something else than at first; null for one that is empty now. */
export function changed(fields: Iterable<readonly [string, InputField]>): Record<string, unknown> {
  const differs = ({ before, value }: InputField): boolean => JSON.stringify(value()) !== JSON.stringify(before);
  return Object.fromEntries([...fields].filter(([, one]) => differs(one)).map(([name, one]) => [name, one.value()]));
}

let number = 0;

/** The field of an input: boxes, a permission, a choice or a text, as its schema says. */
function fieldOf(name: string, { title = name, description = "", schema }: InputDescription, given: unknown): InputField {
  const id = `input-${(number += 1)}`; // forms may be open side by side
  const words = name === "lods" ? levelsOffered(schema.enum ?? []) : schema.items?.enum;
  const hint = el("p", { class: "hint", id: `${id}-hint` }, description);
  if (words !== undefined) {
    const now = given ?? schema.default ?? [];
    const chosen = Array.isArray(now) ? now.map(String) : String(now).split(",");
    const boxes = new Boxes();
    const reset = (): void => boxes.offer(Object.fromEntries(words.map((word) => [word, labelOf(name, word)])), chosen);
    const chosenNow = (): unknown => (name === "lods" ? lodsInput(boxes.chosen) : boxes.chosen);
    const value = (): unknown => (boxes.chosen.length === 0 ? null : chosenNow());
    reset();
    const element = el("fieldset", { class: "field", "aria-describedby": hint.id }, el("legend", {}, title), boxes.element, hint);
    return { element, value, before: value(), reset, boxes };
  }
  if (schema.type === "boolean") {
    const box = el("input", { type: "checkbox", id, "aria-describedby": hint.id });
    const reset = (): void => void (box.checked = given === true);
    reset();
    const element = el("div", { class: "field" }, el("label", {}, box, ` ${title}`), hint);
    return { element, value: () => box.checked || null, before: given === true || null, reset };
  }
  const text = textOf(given ?? schema.default);
  const offered = name === "verticalUnit" ? { ...schema, enum: schema.enum?.filter((unit) => unit in UNITS || unit === text) } : schema;
  const control = controlOf(offered, id, text, { ...(schema.default == null ? { "": "as in the file" } : {}), ...(name === "verticalUnit" ? UNITS : {}) });
  const value = (): unknown => (control.value.trim() === "" ? null : valueOf(control.value, name === "bbox" ? { type: "array" } : schema));
  return { element: field(title, control, description), value, before: value(), reset: () => void (control.value = text) };
}

function labelOf(input: string, word: string): string {
  return input === "lods" ? `LoD${word}: ${levelWords(word)}` : (TABLES.formats[word] ?? word.replace(":", ", "));
}
