// @vitest-environment happy-dom
import { describe, expect, test } from "vitest";
import type { InputDescription } from "../src/api/types";
import { changed, inputFields } from "../src/submit/input_fields";

const INPUTS: Record<string, InputDescription> = {
  title: { title: "Title", schema: { type: "string" } },
  tiles: { schema: {} },
  licence: { title: "Licence", schema: { type: "string" } },
  publish: { title: "Publish", schema: { type: "array", items: { enum: ["stac", "solar"] } } },
  geoidHeight: { schema: { type: "number" } },
  crs: { title: "CRS", schema: { type: "string" } },
  bbox: { schema: {} },
  points: { title: "Keep the points", description: "With distances.", schema: { type: "boolean", default: false } },
  lods: { schema: { type: "string", default: "2.2", enum: ["1.2", "2.2", "1.2,2.2"] } },
  verticalUnit: { schema: { type: "string", enum: ["m", "ft"] } },
};

function set(element: HTMLElement, value: string | boolean): void {
  const control = element.querySelector<HTMLInputElement>("input, select");
  if (control === null) throw new Error("the field has no control");
  if (typeof value === "boolean") control.checked = value;
  else control.value = value;
}

describe("the fields of a process's inputs", () => {
  test("begin with those that most jobs need, and leave out files", () => {
    expect([...inputFields(INPUTS).keys()]).toEqual(["crs", "lods", "publish", "title", "licence", "geoidHeight", "bbox", "points", "verticalUnit"]);
  });

  test("give nothing while nothing is changed, whatever is given", () => {
    expect(changed(inputFields(INPUTS))).toEqual({});
    const given = { lods: "1.2,2.2", publish: ["solar"], points: true, bbox: [0, 0, 10, 10], crs: "EPSG:28992" };
    const fields = inputFields(INPUTS, given);
    expect(changed(fields)).toEqual({});
    for (const [name, value] of Object.entries(given)) expect(fields.get(name)?.value()).toEqual(value);
  });

  test("give what is set by its type, null for what is emptied, and nothing after a reset", () => {
    const fields = inputFields(INPUTS, { licence: "CC0", points: true });
    const values = { crs: "EPSG:28992", licence: " ", geoidHeight: "43.5", bbox: "1, 2, 3, 4", points: false, lods: true, publish: true, verticalUnit: "m" };
    for (const [name, value] of Object.entries(values)) set(fields.get(name)?.element as HTMLElement, value);
    const given = { crs: "EPSG:28992", licence: null, geoidHeight: 43.5, bbox: [1, 2, 3, 4], points: null, lods: "1.2,2.2", publish: ["stac"], verticalUnit: "m" };
    expect(changed(fields)).toEqual(given);
    for (const field of fields.values()) field.reset();
    expect(changed(fields)).toEqual({});
  });

  test("have ids of their own in each form", () => {
    const [one, other] = [inputFields(INPUTS), inputFields(INPUTS)].map((fields) => fields.get("crs")?.element.querySelector("input")?.id);
    expect(one).not.toBe(other);
  });
});
