import { Box3, Matrix4, PerspectiveCamera, Ray, Vector3 } from "three";
import { expect, test } from "vitest";
import { classNumber, type PointColouring } from "../src/points/points_colouring";
import { NO_PLANE, NO_RESIDUAL } from "../src/points/points_glb";
import { PointsLayer } from "../src/points/points_layer";
import type { Tile } from "../src/points/points_tileset";
import { glbOf } from "./point_files";

const COUNT = 100;

const boxAt = (x: number, length: number): Box3 =>
  new Box3().setFromCenterAndSize(new Vector3(x, 0, 2), new Vector3(length, 10, 4));

/** A row of nodes of 10 m below a root; their points lie in a line of steps of 1 cm, 2 m above the origin. */
function row(length: number): Tile {
  const leaf = (n: number): Tile => ({
    points: `node ${n}`,
    tileset: null,
    inner: null,
    box: boxAt(10 * n + 5, 10),
    errorM: 0,
    count: COUNT,
    offset: [10 * n, 0, 0],
    children: [],
  });
  const children = Array.from({ length }, (_, n) => leaf(n));
  return { ...leaf(0), points: null, count: 0, box: boxAt(5 * length, 10 * length), errorM: 1000, offset: [0, 0, 0], children };
}

const FILE = glbOf(
  Array.from({ length: COUNT }, (_, i) => ({ place: [10 * i, 2000, 1000] as [number, number, number], code: 6 })),
  [0, 0, 0],
  0.001,
);

/** A layer whose files arrive when the test says so. */
function layerOf(root: Tile, budget: number) {
  const waiting = new Map<string, { resolve: (file: ArrayBuffer) => void; reject: (fault: unknown) => void; signal: AbortSignal }>();
  const faults: unknown[] = [];
  const layer = new PointsLayer(
    root,
    [100, 0, 0],
    budget,
    (address, signal) =>
      new Promise((resolve, reject) => {
        waiting.set(address, { resolve, reject, signal });
        signal.addEventListener("abort", () => reject(new DOMException("cancelled", "AbortError")));
      }),
    { onArrival: () => undefined, onFault: (fault) => faults.push(fault), onFrame: () => undefined },
  );
  const camera = new PerspectiveCamera(40, 1, 0.1, 10_000);
  camera.up.set(0, 0, 1);
  /** Draw a frame from 20 m above a place; then let what was asked for arrive, until nothing is. */
  const look = async (x: number): Promise<void> => {
    camera.position.set(100 + x, 0, 20);
    camera.lookAt(100 + x, 0.001, 0);
    for (;;) {
      layer.update(camera, 800);
      if (waiting.size === 0) return;
      for (const [address, { resolve }] of [...waiting]) {
        waiting.delete(address);
        resolve(FILE);
      }
      await new Promise((done) => setTimeout(done));
    }
  };
  return { layer, camera, waiting, faults, look };
}

Object.assign(globalThis, { devicePixelRatio: 1 });

test("points lie where the octree says, y up turned to z up", async () => {
  const { layer, look } = layerOf(row(1), 1000);
  await look(5);
  expect(layer.figures).toMatchObject({ points: COUNT, nodes: 1, kept: COUNT, missing: 0 });
  const [node] = layer.object.children;
  const last = new Vector3(990, 2000, 1000).applyMatrix4(node.matrixWorld);
  // the origin at 100, 99 steps of 10 mm to the east, z to the south, y up
  expect(last.toArray()).toEqual([expect.closeTo(100.99, 9), expect.closeTo(-1, 9), expect.closeTo(2, 9)]);
  expect(new Matrix4().copy(node.matrixWorld).determinant()).toBeGreaterThan(0);
});

test("memory stays bounded on a way along all nodes, and what comes back is loaded again", async () => {
  const budget = 4 * COUNT;
  const { layer, look } = layerOf(row(200), budget);
  for (let x = 5; x < 2000; x += 10) {
    await look(x);
    expect(layer.figures.points).toBeLessThanOrEqual(budget);
    expect(layer.figures.kept).toBeLessThanOrEqual(1.5 * budget);
    expect(layer.object.children.length * COUNT).toBe(layer.figures.kept);
  }
  await look(5);
  expect(layer.figures.points).toBeGreaterThan(0);
});

test("at most six files are on their way, and those no longer wanted are called off", async () => {
  const { layer, camera, waiting } = layerOf(row(50), 1000 * COUNT);
  camera.position.set(350, -900, 20);
  camera.lookAt(350, 0, 0);
  layer.update(camera, 800);
  expect(waiting.size).toBe(6);
  const asked = [...waiting.values()];
  camera.lookAt(350, -2000, 0); // away from all
  layer.update(camera, 800);
  expect(asked.every(({ signal }) => signal.aborted)).toBe(true);
});

test("a file that cannot be read is reported once, and read when asked again", async () => {
  const { layer, camera, waiting, faults } = layerOf(row(1), 1000);
  camera.position.set(105, 0, 20);
  camera.lookAt(105, 0.001, 0);
  layer.update(camera, 800);
  waiting.get("node 0")?.reject(new Error("gone"));
  waiting.clear();
  await new Promise((done) => setTimeout(done));
  layer.update(camera, 800);
  expect([faults.length, waiting.size, layer.figures.missing]).toEqual([1, 0, 0]);
  layer.retry();
  layer.update(camera, 800);
  expect(waiting.size).toBe(1);
});

test("a ray meets the point beside it, not one behind a nearer surface", async () => {
  const { layer, look } = layerOf(row(1), 1000);
  await look(5);
  const ray = new Ray(new Vector3(100.501, -1, 12), new Vector3(0, 0, -1));
  expect(layer.pick(ray, 0.001, 20)?.toArray()).toEqual([expect.closeTo(100.5, 6), expect.closeTo(-1, 6), expect.closeTo(2, 6)]);
  expect(layer.pick(ray, 0.001, 9)).toBeNull();
  expect(layer.pick(new Ray(new Vector3(100.5, -1.5, 12), new Vector3(0, 0, -1)), 0.001, 20)).toBeNull();
});

test("a ray passes points of a hidden class", async () => {
  const { layer, look } = layerOf(row(1), 1000);
  await look(5);
  const ray = new Ray(new Vector3(100.501, -1, 12), new Vector3(0, 0, -1));
  layer.material.colourBy("class");
  layer.material.show([classNumber(6)], false);
  expect(layer.pick(ray, 0.001, 20)).toBeNull();
  layer.material.show([classNumber(6)], true);
  layer.material.show([classNumber(2)], false);
  expect(layer.pick(ray, 0.001, 20)).not.toBeNull();
});

test("what is hidden depends on the colouring, and a change of it shows everything", () => {
  const { material } = layerOf(row(1), 1000).layer;
  const seen = (): boolean[] => [
    material.hides(6, 8, 32768 + 51),
    material.hides(2, 1, 32768 + 50),
    material.hides(31, NO_PLANE, NO_RESIDUAL),
  ];
  const hide = (colouring: PointColouring, number: number): boolean[] => {
    material.colourBy(colouring);
    expect(seen()).toEqual([false, false, false]);
    material.show([number], false);
    return seen();
  };
  expect(hide("residual", 4)).toEqual([true, false, false]); // above 50 mm
  expect(hide("residual", 3)).toEqual([false, true, false]);
  expect(hide("residual", 7)).toEqual([false, false, true]);
  expect(hide("plane", 1)).toEqual([true, true, false]); // the colours repeat after seven
  expect(hide("plane", 7)).toEqual([false, false, true]);
  expect(hide("class", classNumber(31))).toEqual([false, false, true]);
  expect(hide("height", 0)).toEqual([false, false, false]);
});

test("an inner tileset is read in its own frame", async () => {
  const outer: Tile = { ...row(1).children[0], points: null, count: 0, tileset: "http://x/inner/tileset.json", offset: [7, 0, 0] };
  const { layer, camera, waiting } = layerOf(outer, 1000);
  camera.position.set(105, 0, 20);
  camera.lookAt(105, 0.001, 0);
  layer.update(camera, 800);
  const inner = {
    asset: { version: "1.1" },
    root: { boundingVolume: { box: [0, 0, 2, 5, 0, 0, 0, 5, 0, 0, 0, 2] }, geometricError: 0, refine: "ADD", content: { uri: "r.glb" }, extras: { points: COUNT } },
  };
  waiting.get("http://x/inner/tileset.json")?.resolve(new TextEncoder().encode(JSON.stringify(inner)).buffer);
  waiting.clear();
  await new Promise((done) => setTimeout(done));
  layer.update(camera, 800);
  waiting.get("http://x/inner/r.glb")?.resolve(FILE);
  await new Promise((done) => setTimeout(done));
  layer.update(camera, 800);
  const [node] = layer.object.children;
  expect(new Vector3(0, 2000, 0).applyMatrix4(node.matrixWorld).toArray()).toEqual([107, expect.closeTo(0, 9), expect.closeTo(2, 9)]);
});
