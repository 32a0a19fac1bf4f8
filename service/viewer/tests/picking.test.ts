import { Ray, Vector3 } from "three";
import { expect, test } from "vitest";
import { Batcher, type Batch } from "../src/models/batching";
import { SequenceReader, type Building } from "../src/models/cityjson";
import { boxDistance, pick } from "../src/scene/picking";
import { GABLE, METADATA } from "./gable";

/** Houses side by side, 20 m apart, the first in the middle of the frame. */
function houses(count: number): Batch[] {
  const reader = new SequenceReader();
  reader.read(JSON.stringify(METADATA));
  const batcher = new Batcher({ origin: [565005, 5934003, 90], horizontalUnitM: 1, verticalUnitM: 1 });
  for (let i = 0; i < count; i++) {
    const house = reader.read(JSON.stringify(GABLE)) as Building;
    house.vertices = house.vertices.map((value, at) => (at % 3 === 0 ? value + 20 * i : value));
    batcher.add({ ...house, id: `house ${i}` });
  }
  return batcher.take().batches;
}

type Xyz = [number, number, number];
const ray = (origin: Xyz, direction: Xyz): Ray => new Ray(new Vector3(...origin), new Vector3(...direction));

test("a ray from above meets the roof of the building beneath it", () => {
  const batches = houses(5);
  for (let i = 0; i < 5; i++) {
    const hit = pick(batches, ray([20 * i, 1, 100], [0, 0, -1]));
    expect(hit?.batch.listed[hit.index].id).toBe(`house ${i}`);
    expect(hit?.distance).toBeCloseTo(100 - (5 - 2 / 3), 5);
  }
});

test("the first of several buildings in a row is met, from either side", () => {
  const batches = houses(4);
  const from = (x: number, dx: number) => pick(batches, ray([x, 0, 1], [dx, 0, 0]));
  expect(from(-50, 1)?.index).toBe(0);
  expect(from(200, -1)?.index).toBe(3);
  expect(from(200, 1)).toBeNull();
});

test("a ray through the box but beside the gable meets nothing", () => {
  expect(pick(houses(1), ray([-50, 2.9, 4.5], [1, 0, 0]))).toBeNull();
  expect(pick(houses(1), ray([-50, 0, 4.5], [1, 0, 0]))).not.toBeNull();
});

test("a batch knows where each building begins and ends", () => {
  const [batch] = houses(3);
  expect(batch.listed).toHaveLength(3);
  expect(batch.starts[3]).toBe(batch.positions.length / 3);
  expect(batch.edgeStarts[3]).toBe(batch.edges.length / 3);
  expect([...batch.boxes.slice(6, 12)]).toEqual([15, -3, 0, 25, 3, 5]);
});

test("from within a house only the next house has an outer side", () => {
  const batches = houses(2);
  expect(pick(batches, ray([0, 0, 1], [1, 0, 0]))?.distance).toBeCloseTo(5, 5);
  const hit = pick(batches, ray([0, 0, 1], [1, 0, 0]), true);
  expect(hit?.index).toBe(1);
  expect(hit?.distance).toBeCloseTo(15, 5);
});

test("the distance to the nearest house is that to its box", () => {
  const batches = houses(3);
  expect(boxDistance(batches, new Vector3(...[0, 0, 1]))).toBe(0);
  expect(boxDistance(batches, new Vector3(...[20, 3 + 4, 5 + 3]))).toBeCloseTo(5, 5);
  expect(boxDistance([], new Vector3(...[0, 0, 0]))).toBe(Infinity);
});

test("a house that is hidden is neither met nor near", () => {
  const [batch] = houses(2);
  batch.shown = Uint8Array.from([0, 1]);
  expect(pick([batch], ray([-50, 0, 1], [1, 0, 0]))?.index).toBe(1);
  expect(pick([batch], ray([0, 1, 100], [0, 0, -1]))).toBeNull();
  expect(boxDistance([batch], new Vector3(...[0, 0, 1]))).toBeCloseTo(15, 5);
});
