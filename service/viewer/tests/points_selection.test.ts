import { Box3, Vector3 } from "three";
import { expect, test } from "vitest";
import { selected, type View } from "../src/points/points_selection";
import type { Tile, Xyz } from "../src/points/points_tileset";

const COUNT = 1000;

/** A quadtree over a square: each level halves the size and the error. */
function quadtree(size: number, depth: number, centre: Xyz = [0, 0, 0], name = "r"): Tile {
  const quarter = size / 4;
  return {
    points: name,
    tileset: null,
    inner: null,
    box: new Box3().setFromCenterAndSize(new Vector3(...centre), new Vector3(size, size, 10)),
    errorM: depth === 0 ? 0 : size / 25,
    count: COUNT,
    offset: [0, 0, 0],
    children:
      depth === 0
        ? []
        : [0, 1, 2, 3].map((n) =>
            quadtree(size / 2, depth - 1, [centre[0] + quarter * (n & 1 ? 1 : -1), centre[1] + quarter * (n & 2 ? 1 : -1), 0], name + n),
          ),
  };
}

const EVERYWHERE: View = { eye: new Vector3(0, 0, 50), pixelsPerMetre: 1000, sees: () => true };
const FREE = { errorPx: 8, points: Infinity };

const names = (root: Tile, view: View, limits = FREE) => selected(root, view, limits).tiles.map(({ points }) => points as string);

test("a node is drawn only with all nodes above it, which come first", () => {
  const drawn = names(quadtree(1000, 5), { ...EVERYWHERE, eye: new Vector3(200, 130, 40) });
  const before = new Set<string>();
  for (const name of drawn) {
    if (name !== "r") expect(before).toContain(name.slice(0, -1));
    before.add(name);
  }
  expect(drawn.length).toBeGreaterThan(10);
});

test("near nodes are finer than far ones", () => {
  const drawn = names(quadtree(4000, 6), { ...EVERYWHERE, eye: new Vector3(1990, 1990, 30) });
  const depth = (corner: string) => Math.max(...drawn.filter((name) => name.startsWith(`r${corner}`)).map((name) => name.length));
  expect(depth("3")).toBeGreaterThan(depth("0") + 1);
});

test("the budget is kept, and what it cuts off is the least wanted", () => {
  const root = quadtree(1000, 5);
  const all = names(root, EVERYWHERE);
  const limits = { ...FREE, points: 20 * COUNT };
  const some = names(root, EVERYWHERE, limits);
  expect(some).toEqual(all.slice(0, 20));
});

test("a hundred times as many points do not make the selection larger than the budget", () => {
  const limits = { ...FREE, points: 50 * COUNT };
  for (const depth of [4, 7]) {
    const { tiles } = selected(quadtree(8000, depth), { ...EVERYWHERE, eye: new Vector3(0, 0, 10) }, limits);
    expect(tiles.reduce((sum, { count }) => sum + count, 0)).toBeLessThanOrEqual(limits.points);
  }
});

test("a view with more pixels wants more nodes, one from farther away fewer", () => {
  const root = quadtree(1000, 5);
  const usual = names(root, { ...EVERYWHERE, eye: new Vector3(0, 0, 800) }).length;
  expect(names(root, { ...EVERYWHERE, eye: new Vector3(0, 0, 800), pixelsPerMetre: 3000 }).length).toBeGreaterThan(usual);
  expect(names(root, { ...EVERYWHERE, eye: new Vector3(0, 0, 8000) }).length).toBeLessThan(usual);
});

test("what is out of the view is not drawn, nor anything below it", () => {
  const west = names(quadtree(1000, 4), { ...EVERYWHERE, sees: (box) => box.min.x < 0 });
  expect(west.some((name) => name.startsWith("r0"))).toBe(true);
  expect(west.every((name) => name === "r" || name.startsWith("r0") || name.startsWith("r2"))).toBe(true);
});

test("a tileset that is not read yet is asked for when it would be drawn", () => {
  const root = { ...quadtree(1000, 1), points: null, count: 0 };
  root.children = root.children.map((child) => ({ ...child, tileset: `${child.points}.json`, points: null, count: 0 }));
  const { tiles, unread } = selected(root, EVERYWHERE, FREE);
  expect(tiles).toEqual([]);
  expect(unread.map(({ tileset }) => tileset)).toEqual(["r0.json", "r1.json", "r2.json", "r3.json"]);
  expect(selected(root, { ...EVERYWHERE, eye: new Vector3(0, 0, 1e6) }, FREE).unread).toEqual([]);
});

test("the root of a tileset that was read is drawn wherever the node is that holds it", () => {
  const root = { ...quadtree(1000, 0), points: null, count: 0, inner: quadtree(1000, 3) };
  expect(names(root, { ...EVERYWHERE, eye: new Vector3(0, 0, 1e6) })).toEqual(["r"]);
  expect(names(root, EVERYWHERE)).toEqual(names(quadtree(1000, 3), EVERYWHERE));
});
