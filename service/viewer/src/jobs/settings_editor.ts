import type { SettingSchema } from "../api/types";
import { button, el } from "../page/elements";
import { controlOf, textOf, valueOf } from "../page/form_fields";
import { announce } from "../page/notices";
import { known, rangeWords, type Flat } from "./settings_changes";
import "./settings_editor.css";

/** The settings that differ from the usual ones: one row each, and a field that adds any of the others. */
export class SettingsEditor {
  readonly element: HTMLElement;
  private readonly known: Map<string, SettingSchema>;
  private readonly rows = new Map<string, HTMLInputElement | HTMLSelectElement>();
  private readonly list = el("ul", { class: "settings" });
  private readonly name = el("input", { type: "text", id: "setting-name", list: "setting-names", autocomplete: "off", spellcheck: "false" });
  private readonly note = el("p", { class: "hint", "aria-live": "polite" });

  /**
   * @param schema The settings that the process knows.
   * @param before The settings of the job.
   * @param elsewhere Settings that other fields of the form set.
   */
  constructor(
    schema: SettingSchema,
    readonly before: Flat,
    elsewhere: ReadonlySet<string>,
  ) {
    this.known = known(schema);
    for (const name of elsewhere) this.known.delete(name);
    for (const [name, value] of before) this.add(name, textOf(value));
    this.name.addEventListener("keydown", (event) => {
      if (event.key !== "Enter") return;
      event.preventDefault(); // it would send the form
      this.addNamed();
    });
    this.name.setAttribute("aria-describedby", "setting-hint");
    this.note.id = "setting-hint";
    this.note.textContent = `One of ${this.known.size}, by the name of its table and its own.`;
    this.element = el(
      "fieldset",
      { class: "field" },
      el("legend", {}, "Settings"),
      this.list,
      el("label", { for: this.name.id, class: "setting-label" }, "Another setting"),
      el("div", { class: "setting-add" }, this.name, button("Add", () => this.addNamed())),
      el("datalist", { id: "setting-names" }, ...[...this.known.keys()].map((value) => el("option", { value }))),
      this.note,
    );
  }

  /** The settings as they are in the fields. */
  value(): Flat {
    return new Map([...this.rows].map(([name, field]) => [name, valueOf(field.value, this.known.get(name) ?? {})]));
  }

  private addNamed(): void {
    const name = this.name.value.trim();
    const schema = this.known.get(name);
    if (schema === undefined) {
      this.note.textContent = name === "" ? "Choose a setting first." : `There is no setting ${name}.`;
      return;
    }
    if (!this.rows.has(name)) this.add(name, textOf(schema.default));
    this.name.value = "";
    this.note.textContent = "";
    announce(`${name} is added.`);
    this.rows.get(name)?.focus();
  }

  private add(name: string, value: string): void {
    const schema = this.known.get(name) ?? {};
    const id = `setting-${name.replace(/\W/g, "-")}`;
    const field = controlOf(schema, id, value);
    field.setAttribute("aria-describedby", `${id}-hint`);
    const remove = (): void => {
      this.rows.delete(name);
      row.remove();
      this.name.focus();
    };
    const row = el(
      "li",
      {},
      el("div", { class: "setting-head" }, el("label", { for: id }, name), button("×", remove, { class: "icon", "aria-label": `Remove ${name}` })),
      field,
      el("p", { class: "hint", id: `${id}-hint` }, [schema.description ?? "", rangeWords(schema)].filter((part) => part !== "").join(" ")),
    );
    this.rows.set(name, field);
    this.list.append(row);
  }
}

