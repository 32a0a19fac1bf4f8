import { expect, test } from "vitest";
import { buildingMesh, SURFACE } from "../src/models/building_mesh";
import { SequenceReader, type Building } from "../src/models/cityjson";
import { GABLE, METADATA } from "./gable";

const FRAME = { origin: [565005, 5934003, 90], horizontalUnitM: 1, verticalUnitM: 1 } as const;

function gable(): Building {
  const reader = new SequenceReader();
  reader.read(JSON.stringify(METADATA));
  return reader.read(JSON.stringify(GABLE)) as Building;
}

/** Signed volume of the triangles (divergence theorem). */
function volume(positions: number[]): number {
  let sum = 0;
  for (let i = 0; i < positions.length; i += 9) {
    const [ax, ay, az, bx, by, bz, cx, cy, cz] = positions.slice(i, i + 9);
    sum += ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx);
  }
  return sum / 6;
}

test("the triangles close the solid, turned outwards", () => {
  const { positions, surfaces } = buildingMesh(gable(), FRAME);
  expect(volume(positions)).toBeCloseTo(10 * 6 * 3 + (10 * 6 * 2) / 2, 6);
  expect(surfaces.filter((surface) => surface >= 0 || surface === SURFACE.roof)).toHaveLength(12);
});

test("units that are no metres are scaled, horizontal and vertical apart", () => {
  const feet = { ...FRAME, horizontalUnitM: 0.3048, verticalUnitM: 1 };
  expect(volume(buildingMesh(gable(), feet).positions)).toBeCloseTo(240 * 0.3048 ** 2, 6);
});

test("every edge of the house is drawn once", () => {
  expect(buildingMesh(gable(), FRAME).edges.length / 6).toBe(15);
});

test("the edge between two faces of one plane is not drawn", () => {
  const building = gable();
  // the south wall in two halves
  building.vertices = Float64Array.from([...building.vertices, 565005, 5934000, 90, 565005, 5934000, 93]);
  building.faces[2] = { kind: "wall", rings: [[0, 10, 11, 4]] };
  building.faces.push({ kind: "wall", rings: [[10, 1, 5, 11]] });
  const drawn = buildingMesh(building, FRAME).edges;
  const upright: number[] = [];
  for (let i = 0; i < drawn.length; i += 6) if (drawn[i] === 0 && drawn[i + 3] === 0) upright.push(i);
  expect(upright).toEqual([]);
});
