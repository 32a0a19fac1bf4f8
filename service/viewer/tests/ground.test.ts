import { Ray, Vector3 } from "three";
import { expect, test } from "vitest";
import { groundDistance, groundOf, groundThrough, heightAt } from "../src/scene/ground";

const BOX = [-10, -10, 110, 60];

test("one floor makes a level ground", () => {
  const ground = groundThrough([50, 20, 7], BOX, 32);
  for (const height of ground.heights) expect(height).toBeCloseTo(7, 5);
});

test("the ground passes through every floor that has a node of its own", () => {
  const floors = [0, 0, 10, 100, 0, 30, 0, 50, 20, 100, 50, 15];
  const ground = groundThrough(floors, BOX, 120);
  for (let i = 0; i < floors.length; i += 3) expect(heightAt(ground, floors[i], floors[i + 1])).toBeCloseTo(floors[i + 2], 4);
});

test("between and beyond the floors the ground stays between them", () => {
  const floors = Array.from({ length: 40 }, (_, i) => [(i * 37) % 100, (i * 17) % 50, 5 + (i % 7)]).flat();
  const { heights } = groundThrough(floors, BOX, 64);
  expect(Math.min(...heights)).toBeGreaterThanOrEqual(5);
  expect(Math.max(...heights)).toBeLessThanOrEqual(11);
});

test("a ray meets the ground where it falls below it, and none above it or beside it", () => {
  const ground = groundThrough([0, 0, 0, 100, 0, 50, 0, 50, 0, 100, 50, 50], [0, 0, 100, 50], 100);
  const down = new Vector3(0, 0, -1);
  const from = (x: number, y: number, z: number, direction: Vector3): Ray => new Ray(new Vector3(x, y, z), direction);
  expect(groundDistance(ground, from(70, 20, 200, down))).toBeCloseTo(200 - heightAt(ground, 70, 20), 5);
  const level = groundDistance(ground, from(1, 25, 30, new Vector3(1, 0, 0)));
  expect(heightAt(ground, 1 + level, 25)).toBeCloseTo(30, 4);
  expect(groundDistance(ground, from(1, 25, 30, new Vector3(-1, 0, 0)))).toBe(Infinity);
  expect(groundDistance(ground, from(1, 25, 60, new Vector3(1, 0, 0)))).toBe(Infinity);
  expect(groundDistance(ground, from(200, 25, 60, down))).toBe(Infinity);
  expect(groundDistance(groundThrough([50, 20, 7], BOX, 32), from(50, 20, 17, down))).toBeCloseTo(10, 5);
});

test("the terrain of a run lies about the scene's origin, and unknown nodes lie between known ones", () => {
  const file = { origin_m: [84000.5, 447000.5], spacing_m: 2, elevation_unit_m: 0.01, elevations: [[150, null, 350], [250, 250, 250]] } as const;
  const ground = groundOf(file, [84000, 447000, 1]);
  if (ground === null) throw new Error("no ground");
  expect([ground.nx, ground.ny]).toEqual([3, 2]);
  expect(heightAt(ground, 0.5, 0.5)).toBeCloseTo(0.5, 5);
  expect(heightAt(ground, 4.5, 0.5)).toBeCloseTo(2.5, 5);
  expect(heightAt(ground, 4.5, 2.5)).toBeCloseTo(1.5, 5);
  expect(heightAt(ground, 2.5, 0.5)).toBeGreaterThan(0.5);
  expect(heightAt(ground, 2.5, 0.5)).toBeLessThan(2.5);
  expect(groundOf({ ...file, elevations: [[null, null]] }, [0, 0, 0])).toBeNull();
  expect(groundOf({ ...file, elevations: [] }, [0, 0, 0])).toBeNull();
});
