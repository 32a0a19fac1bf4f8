import { expect, it } from "vitest";
import { COLUMN_NAMES, COLUMNS, shown } from "../src/models/columns";

it("A value is shown in its unit, with its digits", () => {
  expect(shown("rmse_m", 0.0534)).toBe("0.053\u202fm");
  expect(shown("coverage", 0.975)).toBe("97.5\u202f%");
  expect(shown("n_points", 12_345)).toBe("12\u202f345");
  expect(shown("height_m", 7.25, 0.3048)).toBe("7.25\u202fm");
  expect(shown("height_m", 7.25, 1, 0)).toBe("7\u202fm");
});

it("An elevation is shown in metres, whatever its unit", () => {
  expect(shown("ridge_z", 100, 0.3048)).toBe("30.48\u202fm");
});

it("A value that is missing is shown as a dash", () => {
  for (const name of COLUMN_NAMES) expect([shown(name, null), shown(name, undefined)]).toEqual(["–", "–"]);
});

it("The columns of a section follow one another", () => {
  const sections = COLUMN_NAMES.map((name) => COLUMNS[name].section);
  const starts = sections.filter((section, at) => section !== sections[at - 1]);
  expect(starts).toEqual(["Height", "Size", "Fit to the points"]);
});
