import { expect, test } from "vitest";
import { inWords, measured } from "../src/tools/measuring";

test("the slope distance is the hypotenuse of plan and height", () => {
  expect(measured([1, 2, 10], [4, 6, 22])).toEqual({
    horizontalM: 5,
    heightM: 12,
    slopeM: 13,
    slopeDeg: (Math.atan2(12, 5) * 180) / Math.PI,
  });
});

test("measuring back gives the same distances and the opposite height", () => {
  const [there, back] = [measured([0, 0, 0], [3, -4, 2.5]), measured([3, -4, 2.5], [0, 0, 0])];
  expect(back).toEqual({ ...there, heightM: -2.5, slopeDeg: -there.slopeDeg });
});

test("figures are in metres with a sign for the height", () => {
  expect(inWords(measured([0, 0, 0], [3, 4, 1.5]))).toEqual([
    ["Horizontal distance", "5.00\u202fm"],
    ["Height difference", "+1.50\u202fm"],
    ["Slope distance", "5.22\u202fm"],
    ["Inclination", "16.7\u202f°"],
  ]);
  expect(inWords(measured([0, 0, 9], [3, 4, 9]))[1][1]).toBe("0.00\u202fm");
  expect(inWords(measured([0, 0, 9], [0, 0, 1]))[1][1]).toBe("−8.00\u202fm");
});
