import { expect, test } from "vitest";
import { Batcher, type Batch, type Gathered } from "../src/models/batching";
import { SURFACE } from "../src/models/building_mesh";
import { SequenceReader, type Building } from "../src/models/cityjson";
import { classesOf, coloursOf, CYCLE, outlineColour, type Colouring } from "../src/models/colouring";
import { CATEGORIES } from "../src/words/roof_types";
import { GABLE, METADATA } from "./gable";

/** The house with other attributes. */
function house(id: string, attributes: Record<string, unknown>): Building {
  const reader = new SequenceReader();
  reader.read(JSON.stringify(METADATA));
  const building = reader.read(JSON.stringify(GABLE)) as Building;
  return { ...building, id, attributes: { ...building.attributes, ...attributes } };
}

const HOUSES = [
  house("a", { share_within_0_2m: 0.97, rmse_m: 1.2 }),
  house("b", { share_within_0_2m: 0.6, status: "fallback", reason: "no_plane" }),
  house("c", { share_within_0_2m: null, rmse_m: 0.04, status: "fallback", reason: "crashed" }),
];

function batched(): Gathered {
  const batcher = new Batcher({ origin: [565005, 5934003, 90], horizontalUnitM: 1, verticalUnitM: 1 });
  for (const building of HOUSES) batcher.add(building);
  return batcher.take();
}

/** sRGB bytes to the bytes of linear light that the models have. */
function linear(colour: string): number[] {
  return [1, 3, 5].map((at) => {
    const share = Number.parseInt(colour.slice(at, at + 2), 16) / 255;
    return Math.round(255 * (share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4));
  });
}

/** Colour of the corners of each surface of a building. */
function surfaceColours(batch: Batch, index: number, colouring: Colouring): Map<number, string> {
  const colours = coloursOf(batch, colouring);
  const seen = new Map<number, string>();
  for (let corner = batch.starts[index]; corner < batch.starts[index + 1]; corner++) {
    const colour = [...colours.slice(4 * corner, 4 * corner + 3)].join();
    expect(seen.get(batch.surfaces[corner]) ?? colour).toBe(colour);
    seen.set(batch.surfaces[corner], colour);
  }
  return seen;
}

test("each roof plane has a colour of its own, walls and ground keep theirs", () => {
  const [ok] = batched().batches;
  const byPlane = surfaceColours(ok, 0, "plane");
  expect([...byPlane.keys()].sort()).toEqual([SURFACE.wall, SURFACE.ground, 0, 1].sort());
  expect(byPlane.get(0)).toBe(linear(CYCLE[0]).join());
  expect(byPlane.get(1)).toBe(linear(CYCLE[1]).join());
  const byType = surfaceColours(ok, 0, "type");
  expect(byType.get(0)).toBe(linear(CATEGORIES.gable.colour).join());
  for (const surface of [SURFACE.wall, SURFACE.ground]) expect(byPlane.get(surface)).toBe(byType.get(surface));
});

test("residual, status and reason colour a whole roof as the legend says", () => {
  const { batches, listed } = batched();
  for (const colouring of ["residual", "status", "reason"] as const) {
    for (const { id } of HOUSES) {
      const batch = batches.find(({ listed: those }) => those.some((one) => one.id === id)) as Batch;
      const roofs = surfaceColours(batch, batch.listed.findIndex((one) => one.id === id), colouring);
      const [own] = classesOf(colouring, listed.filter((one) => one.id === id));
      expect(new Set([roofs.get(0), roofs.get(1)])).toEqual(new Set([linear(own.colour).join()]));
    }
  }
});

test("outlines on the map have the colours of the legend", () => {
  const { listed } = batched();
  for (const colouring of ["residual", "status", "reason"] as const) {
    for (const one of listed) expect(outlineColour(colouring, one)).toBe(classesOf(colouring, [one])[0].colour);
  }
  expect(listed.map((one) => outlineColour("type", one))).toEqual(listed.map(({ category }) => CATEGORIES[category].colour));
  expect(outlineColour("plane", listed[0])).toBe(outlineColour("plain", listed[1]));
});

test("the legend counts the buildings of each class and leaves out empty ones", () => {
  const { listed } = batched();
  const counts = (colouring: "residual" | "status" | "reason") => classesOf(colouring, listed).map(({ label, count }) => [label, count]);
  expect(counts("residual")).toEqual([["95 % or more within 0.2 m", 1], ["50 to 75 %", 1], ["unknown", 1]]);
  expect(counts("status")).toEqual([["Modelled", 1], ["Fallback block", 2]]);
  expect(counts("reason")).toEqual([
    ["none: modelled in full", 1],
    ["no roof plane was found in its points", 1],
    ["a fault, a crash, or a limit of time or memory", 1],
  ]);
  expect(classesOf("status", [])).toEqual([]);
});

test("a share on the border of two classes belongs to the better one", () => {
  const { listed } = batched();
  const label = (within: number) => classesOf("residual", [{ ...listed[0], figures: { within } }])[0].label;
  expect([1, 0.95, 0.9499, 0.9, 0.75, 0.5, 0.4999, 0].map(label)).toEqual([
    "95 % or more within 0.2 m", "95 % or more within 0.2 m", "90 to 95 %", "90 to 95 %", "75 to 90 %", "50 to 75 %",
    "under 50 %", "under 50 %",
  ]);
});

test("a chimney does not turn a roof red: its few points leave the class, however high they are", () => {
  const { listed } = batched();
  expect(listed[0].figures.residual).toBe(1.2);
  expect(classesOf("residual", listed.slice(0, 1))[0].colour).toBe("#0072b2");
});

test("single buildings have a colour of their own, the others that of their type", () => {
  const { batches } = batched();
  const batch = batches.find(({ listed }) => listed.some(({ id }) => id === "b")) as Batch;
  const colours = coloursOf(batch, (id) => (id === "b" ? "#ff0080" : null));
  const roofs = batch.listed.map((_, n) => {
    const corner = [...batch.surfaces].findIndex((surface, at) => at >= batch.starts[n] && surface >= 0);
    return [...colours.subarray(4 * corner, 4 * corner + 4)];
  });
  const own = [...linear(CATEGORIES[batch.category].colour), 255];
  expect(roofs).toEqual(batch.listed.map(({ id }) => (id === "b" ? [255, 0, 55, 255] : own)));
});
