import { expect, it } from "vitest";
import type { StatusInfo } from "../src/api/types";
import { stageNamed, stagesOf } from "../src/progress/stages";

const names = (processID: string, inputs: Record<string, unknown> = {}): string[] =>
  stagesOf({ jobID: "a", status: "running", processID, request: { inputs } } satisfies StatusInfo).map(({ name }) => name);

const FOUND = ["inputs", "plan", "ingest", "cells", "ground", "split", "join", "outline"];

it("A job has the stages of what it makes, in their order", () => {
  expect(names("reconstruct")).toEqual([...FOUND, "reconstruct", "publish", "outputs"]);
  expect(names("reconstruct", { points: true, publish: ["stac"], settings: { terrain: "tin" } })).toEqual([
    ...FOUND, "reconstruct", "publish", "octree", "terrain", "formats", "outputs",
  ]);
  expect(names("reconstruct", { points: false, publish: [], settings: { terrain: "grid" } })).toEqual(names("reconstruct"));
  expect(names("compare", { points: true })).toEqual([...FOUND, "reconstruct", "publish", "records", "points", "pictures", "page", "outputs"]);
  expect(names("classify", { points: true })).toEqual([...FOUND, "classify", "write", "rasters", "mosaics", "outputs"]);
  expect(names("echo")).toEqual([]);
});

it("A stage that the page does not know is shown by its name", () => {
  expect(stageNamed("reconstruct").unit).toBe("buildings");
  expect(stageNamed("compile").words).toBe("Compile, once on this machine");
  expect(stageNamed("weigh")).toMatchObject({ name: "weigh", words: "weigh", unit: "" });
});
