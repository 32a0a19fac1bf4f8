import { Vector3 } from "three";
import { expect, test } from "vitest";
import { measured } from "../src/tools/measure_tool";

const figures = (from: number[], to: number[]): string[] => measured(new Vector3(...from), new Vector3(...to)).map(([, figure]) => figure.replaceAll("\u202f", " "));

test("the slope distance is the hypotenuse of plan and height, and the height has a sign", () => {
  expect(figures([1, 2, 10], [4, 6, 22])).toEqual(["5.00 m", "+12.00 m", "13.00 m", "67.4 °"]);
  expect(figures([0, 0, 0], [3, 4, 1.5])).toEqual(["5.00 m", "+1.50 m", "5.22 m", "16.7 °"]);
});

test("measuring back gives the same distances and the opposite height", () => {
  expect(figures([0, 0, 0], [3, -4, 2.5])).toEqual(["5.00 m", "+2.50 m", "5.59 m", "26.6 °"]);
  expect(figures([3, -4, 2.5], [0, 0, 0])).toEqual(["5.00 m", "−2.50 m", "5.59 m", "−26.6 °"]);
});

test("a level line and one without a plan have their figures, too", () => {
  expect(figures([0, 0, 9], [3, 4, 9])).toEqual(["5.00 m", "0.00 m", "5.00 m", "0.0 °"]);
  expect(figures([0, 0, 9], [0, 0, 1])).toEqual(["0.00 m", "−8.00 m", "8.00 m", "−90.0 °"]);
});
