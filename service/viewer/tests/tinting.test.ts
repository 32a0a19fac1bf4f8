import { expect, test } from "vitest";
import { SURFACE, type Batch } from "../src/models/batching";
import { tintRoofs } from "../src/models/colouring";

test("only the roofs of the buildings with a colour change", () => {
  const surfaces = Int16Array.from([7, SURFACE.wall, SURFACE.ground, SURFACE.roof, 0]); // the roof of b is the last
  const batch = { ids: ["a", "b"], starts: Uint32Array.from([0, 4, 5]), surfaces } as Partial<Batch> as Batch;
  const before = Uint8Array.from({ length: 20 }, (_, n) => n);
  const colours = before.slice();
  tintRoofs(batch, colours, (id) => (id === "a" ? "#ff0080" : null));
  expect([...colours.subarray(0, 4)]).toEqual([255, 0, 55, 3]);
  expect([...colours.subarray(4, 12)]).toEqual([...before.subarray(4, 12)]);
  expect([...colours.subarray(12, 16)]).toEqual([255, 0, 55, 15]);
  expect([...colours.subarray(16)]).toEqual([...before.subarray(16)]);
});
