import { getJson, pathOfJob, sendJson } from "../api/requests";
import type { InputDescription, StatusInfo } from "../api/types";
import { openForm } from "../page/dialogs";
import { el } from "../page/elements";
import { Boxes, controlOf, field } from "../page/form_fields";
import { announce } from "../page/notices";
import { jobsChanged } from "../page/view";
import { titleOf } from "./job_words";
import { changes, flat } from "./settings_changes";
import { SettingsEditor } from "./settings_editor";

/** Inputs that a form cannot change, or that have a part of their own. */
const ELSEWHERE = new Set(["tiles", "footprints", "guides", "settings", "priority"]);

/** Inputs that are shown at once; the others are under More. */
const FIRST = ["title", "method", "preset", "methods", "lods", "crs", "message"];

interface Field {
  name: string;
  element: HTMLElement;
  before: string;
  now: () => string;
  value: (text: string) => unknown;
}

/** Open the form that starts a job again, with changes. The inputs are those that the process describes. */
export async function openRetry(job: StatusInfo): Promise<void> {
  const process = job.processID ?? "reconstruct";
  const { inputs } = await getJson<{ inputs: Record<string, InputDescription> }>(`processes/${encodeURIComponent(process)}`);
  const before = job.request?.inputs ?? {};
  const settings = (before["settings"] ?? {}) as Record<string, unknown>;
  const fields = Object.entries(inputs)
    .filter(([name]) => !ELSEWHERE.has(name))
    .map(([name, description]) => fieldOf(name, description, before[name] ?? settings[name]));
  const names = new Set(fields.map(({ name }) => name));
  const own = new Map([...flat(settings)].filter(([name]) => !names.has(name)));
  const schema = inputs["settings"]?.schema;
  const editor = schema === undefined ? null : new SettingsEditor(schema, own, names);
  const [first, more] = [true, false].map((isFirst) =>
    fields.filter(({ name }) => FIRST.includes(name) === isFirst).map(({ element }) => element),
  );
  openForm("Try again", {
    content: [
      el("p", {}, `A new job with the files of “${titleOf(job)}”. What you do not change stays as it was.`),
      ...(first ?? []),
      editor?.element ?? null,
      more === undefined || more.length === 0 ? null : el("details", { class: "options" }, el("summary", {}, "More"), ...more),
    ],
    send: "Start the new job",
    act: async () => {
      const given: Record<string, unknown> = {};
      for (const { name, before: was, now, value } of fields) {
        const text = now();
        if (text !== was) given[name] = text === "" ? null : value(text);
      }
      const changed = editor === null ? {} : changes(editor.before, editor.value());
      if (Object.keys(changed).length > 0) given["settings"] = changed;
      const response = await sendJson("POST", `${pathOfJob(job.jobID)}/retry`, { inputs: given });
      const { jobID } = (await response.json()) as StatusInfo;
      announce("The new job is submitted.");
      jobsChanged();
      location.hash = `#/jobs/${jobID}`;
    },
  });
}

/** The field of an input: a choice, boxes or a text, as its schema says. */
function fieldOf(name: string, { title, description, schema }: InputDescription, given: unknown): Field {
  const id = `retry-${name}`;
  const label = title ?? name;
  const hint = el("p", { class: "hint", id: `${id}-hint` }, description ?? "");
  if (schema.items?.enum !== undefined) return boxesOf(name, label, hint, schema.items.enum, given);
  if (schema.type === "boolean") {
    const box = el("input", { type: "checkbox", id, checked: given === true, "aria-describedby": hint.id });
    const element = el("div", { class: "field" }, el("label", {}, box, ` ${label}`), hint);
    const now = (): string => (box.checked ? "true" : "");
    return { name, element, before: now(), now, value: () => true };
  }
  const text = given ?? schema.default ?? "";
  const shown = Array.isArray(text) ? text.join(", ") : String(text);
  const control = controlOf(schema, id, shown, schema.default == null ? { "": "as in the file" } : {});
  const element = field(label, control, description ?? "");
  const value = (typed: string): unknown => {
    if (name === "bbox") return typed.split(",").map(Number);
    return schema.type === "number" && Number.isFinite(Number(typed)) ? Number(typed) : typed;
  };
  const now = (): string => control.value.trim();
  return { name, element, before: now(), now, value };
}

function boxesOf(name: string, label: string, hint: HTMLElement, words: string[], given: unknown): Field {
  const boxes = new Boxes();
  boxes.offer(Object.fromEntries(words.map((value) => [value, value.replace(":", ", ")])), Array.isArray(given) ? given.map(String) : []);
  const element = el("fieldset", { class: "field", "aria-describedby": hint.id }, el("legend", {}, label), boxes.element, hint);
  const now = (): string => boxes.chosen.join(",");
  return { name, element, before: now(), now, value: (text) => text.split(",") };
}
