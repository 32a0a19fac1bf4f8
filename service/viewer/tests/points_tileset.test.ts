import { Vector3 } from "three";
import { expect, test } from "vitest";
import { factsOf, rootOf, type RawTileset } from "../src/points/points_tileset";

const ADDRESS = "https://service.example/jobs/1/points/tileset.json";
const BOX = { box: [10, 20, 5, 10, 0, 0, 0, 20, 0, 0, 0, 5] };
const shift = (x: number, y: number, z: number) => [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, y, z, 1];

const OUTER: RawTileset = {
  asset: { version: "1.1" },
  extras: { origin_m: [565000, 5934000, 80], n_points: 1234, classes: { "2": 1000, "6": 234 } },
  root: {
    boundingVolume: BOX,
    geometricError: 40,
    refine: "ADD",
    content: { uri: "upper/0.glb" },
    extras: { points: 10 },
    children: [
      { boundingVolume: BOX, geometricError: 20, transform: shift(100, 0, 2), content: { uri: "x1_y1/tileset.json" }, extras: { points: 900 } },
    ],
  },
};

test("content is found beside its tileset, and an inner tileset is known as one", () => {
  const root = rootOf(OUTER, ADDRESS);
  expect(root.points).toBe("https://service.example/jobs/1/points/upper/0.glb");
  expect([root.tileset, root.count, root.errorM]).toEqual([null, 10, 40]);
  const [inner] = root.children;
  expect(inner.tileset).toBe("https://service.example/jobs/1/points/x1_y1/tileset.json");
  // its points are counted by the nodes that hold them
  expect([inner.points, inner.count]).toEqual([null, 0]);
});

test("translations add up, in boxes and for the content", () => {
  const [inner] = rootOf(OUTER, ADDRESS).children;
  expect([inner.offset, ...inner.box.min, ...inner.box.max]).toEqual([[100, 0, 2], 100, 0, 2, 120, 40, 12]);
  const below = rootOf({ asset: { version: "1.1" }, root: { ...OUTER.root, transform: shift(1, 1, 1), children: [] } }, inner.tileset ?? "", inner.offset);
  expect([below.offset, below.box.getCenter(new Vector3()).toArray()]).toEqual([[101, 1, 3], [111, 21, 8]]);
  expect(below.points).toBe("https://service.example/jobs/1/points/x1_y1/upper/0.glb");
});

test("the facts of the whole are at the root", () => {
  expect(factsOf(OUTER)).toEqual({ originM: [565000, 5934000, 80], nPoints: 1234, classes: { "2": 1000, "6": 234 }, terrain: null });
  expect(factsOf({ ...OUTER, extras: { terrain: "terrain.json" } }).terrain).toBe("terrain.json");
});

test("a tileset of another kind is refused with its fault", () => {
  const wrong = (change: object): RawTileset => ({ ...OUTER, root: { ...OUTER.root, children: [], ...change } });
  expect(() => rootOf(wrong({ refine: "REPLACE" }), ADDRESS)).toThrow("“REPLACE” is not “ADD”");
  expect(() => rootOf(wrong({ boundingVolume: { sphere: [0, 0, 0, 1] } }), ADDRESS)).toThrow("no box");
  expect(() => rootOf(wrong({ transform: [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1] }), ADDRESS)).toThrow("turned or scaled");
  expect(() => rootOf({ ...OUTER, asset: { version: "2.0" } }, ADDRESS)).toThrow("“2.0”");
  expect(() => rootOf({ asset: { version: "1.1" } }, ADDRESS)).toThrow("no root");
});
