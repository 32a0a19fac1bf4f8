import { expect, test } from "vitest";
import { SequenceReader } from "../src/models/cityjson";
import { GABLE, METADATA } from "./gable";

const read = (...lines: unknown[]) => readAt(null, ...lines);

const readAt = (lod: string | null, ...lines: unknown[]) => {
  const reader = new SequenceReader(lod);
  const buildings = lines.map((line) => reader.read(JSON.stringify(line)));
  return { reader, buildings };
};

/** The house with a block of one face beside its own model. */
const TWO_LEVELS = (() => {
  const part = GABLE.CityObjects["house-0"];
  const block = { ...part.geometry[0], lod: "1.2", boundaries: [[[[0, 1, 2, 3]]]] };
  return { ...GABLE, CityObjects: { ...GABLE.CityObjects, "house-0": { ...part, geometry: [block, ...part.geometry] } } };
})();

test("the metadata gives the extent", () => {
  const { reader } = read(METADATA);
  expect(reader.extent).toHaveLength(6);
});

test("a feature gives its vertices in the CRS, its faces by kind and its record", () => {
  const building = read(METADATA, GABLE).buildings[1];
  expect(building?.id).toBe("house");
  expect([...(building?.vertices.slice(27, 30) ?? [])]).toEqual([565010, 5934003, 95]);
  expect(building?.faces.map(({ kind }) => kind)).toEqual(["roof", "roof", "wall", "wall", "wall", "wall", "ground"]);
  expect(building?.attributes["roof_type"]).toBe("gable");
});

test("of several levels of detail the finest is drawn", () => {
  expect(read(METADATA, TWO_LEVELS).buildings[1]?.faces).toEqual(read(METADATA, GABLE).buildings[1]?.faces);
  expect(read(METADATA, TWO_LEVELS).buildings[1]?.levels).toEqual(["1.2", "2.2"]);
  expect(read(METADATA, GABLE).buildings[1]?.levels).toEqual(["2.2"]);
});

test("a level that is asked for is drawn, or the next coarser one that there is, never a finer one", () => {
  const rings = (lod: string, house: unknown) => readAt(lod, METADATA, house).buildings[1]?.faces.map((face) => face.rings);
  expect(rings("1.2", TWO_LEVELS)).toEqual([[[0, 1, 2, 3]]]);
  expect(rings("1.3", TWO_LEVELS)).toEqual([[[0, 1, 2, 3]]]);
  expect(rings("2.2", TWO_LEVELS)).toHaveLength(7);
  expect(rings("1.2", GABLE)).toEqual([]);
});

test("levels to choose from are those of buildings that have several, not a block among roofs", () => {
  expect(read(METADATA, TWO_LEVELS, GABLE).reader.levels).toEqual(["1.2", "2.2"]);
  const part = GABLE.CityObjects["house-0"];
  const fallback = { ...GABLE, CityObjects: { ...GABLE.CityObjects, "house-0": { ...part, geometry: [{ ...part.geometry[0], lod: "1.2" }] } } };
  expect(read(METADATA, fallback, GABLE).reader.levels).toEqual([]);
});

test("of a building of several parts all are drawn at one level", () => {
  const part = { ...TWO_LEVELS.CityObjects["house-0"], geometry: TWO_LEVELS.CityObjects["house-0"].geometry.slice(0, 1) };
  const blockBeside = { ...TWO_LEVELS, CityObjects: { ...TWO_LEVELS.CityObjects, "house-1": part } };
  expect(read(METADATA, blockBeside).buildings[1]?.faces).toHaveLength(7);
  expect(readAt("1.2", METADATA, blockBeside).buildings[1]?.faces).toHaveLength(2);
});

test("a later line of metadata stands for what follows it", () => {
  const moved = { ...METADATA, transform: { scale: [0.01, 0.01, 0.01], translate: [0, 0, 0] } };
  const building = read(METADATA, moved, GABLE).buildings[2];
  expect([...(building?.vertices.slice(27, 30) ?? [])]).toEqual([100, 30, 150]);
});

test("a building without a model is a feature without faces", () => {
  const failed = { type: "CityJSONFeature", id: "x", CityObjects: { x: { type: "Building", attributes: { status: "failed" } } }, vertices: [] };
  const building = read(METADATA, failed).buildings[1];
  expect(building?.faces).toEqual([]);
  expect(building?.attributes["status"]).toBe("failed");
});

test("a file that is not CityJSONSeq is reported", () => {
  expect(() => read(GABLE)).toThrow("does not begin with its metadata");
  expect(() => read({ type: "Feature" })).toThrow("type Feature");
  expect(() => new SequenceReader().read("{")).toThrow(SyntaxError);
});
