import { expect, test } from "vitest";
import { NO_PLANE, NO_RESIDUAL, readNodes } from "../src/points/points_glb";
import { glbOf } from "./point_files";

const POINTS = [
  { place: [0, 1, 65535] as [number, number, number], code: 6, plane: 3, residualMm: -120 },
  { place: [7, 8, 9] as [number, number, number], code: 2 },
];

test("places, classes, planes and residuals of a node are read with their strides", () => {
  const [node] = readNodes(glbOf(POINTS, [1, 2, -3], 0.001)).nodes;
  expect(node.count).toBe(2);
  expect(node.places).toBeInstanceOf(Uint16Array);
  expect([...node.places]).toEqual([0, 1, 65535, 6, 7, 8, 9, 2]);
  expect([...node.labels]).toEqual([3, 32768 - 120, NO_PLANE, NO_RESIDUAL]);
  expect([node.step, node.translation]).toEqual([0.001, [1, 2, -3]]);
});

test("places that are floats stay floats", () => {
  const [node] = readNodes(glbOf([{ place: [0.5, -1.25, 300000.5] }], [0, 0, 0], 1, true)).nodes;
  expect([...node.places]).toEqual([0.5, -1.25, 300000.5, 1]);
});

test("a point takes twelve bytes", () => {
  const [{ places, labels }] = readNodes(glbOf(POINTS, [0, 0, 0], 0.001)).nodes;
  expect(places.byteLength + labels.byteLength).toBe(12 * POINTS.length);
});

test("damaged files and files of another kind are refused", () => {
  const whole = glbOf(POINTS, [0, 0, 0], 0.001);
  expect(() => readNodes(whole.slice(0, whole.byteLength - 4))).toThrow("cut off");
  expect(() => readNodes(new ArrayBuffer(10))).toThrow("not a binary glTF");
  expect(() => readNodes(new TextEncoder().encode("<html>".padEnd(100)).buffer)).toThrow("not a binary glTF");
  const triangles = new TextDecoder("latin1").decode(whole).replace('"mode":0', '"mode":4');
  const bytes = Uint8Array.from(triangles, (letter) => letter.charCodeAt(0));
  expect(() => readNodes(bytes.buffer)).toThrow("no primitive of points");
});
