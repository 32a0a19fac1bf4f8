/** The stages of a job in their order, with the unit that is counted. */

import type { StatusInfo } from "../api/types";

export interface Stage {
  name: string;
  words: string;
  /** What its progress counts; empty for none. */
  unit: string;
}

/** The jobs that have a stage. `compile` is for the first jobs of a new installation. */
type Kind = "all" | "models" | "points" | "terrain" | "formats" | "compare" | "classify" | "compile";

const STAGES: readonly (Stage & { of: Kind })[] = [
  { name: "compile", words: "Compile, once on this machine", unit: "kernels", of: "compile" },
  { name: "inputs", words: "Prepare the inputs", unit: "files", of: "all" },
  { name: "plan", words: "Plan the tiles", unit: "", of: "all" },
  { name: "ingest", words: "Read the points", unit: "files", of: "all" },
  { name: "cells", words: "Mark duplicates and outliers", unit: "tiles", of: "all" },
  { name: "ground", words: "Find the ground", unit: "", of: "all" },
  { name: "split", words: "Find walls and roofs", unit: "tiles", of: "all" },
  { name: "join", words: "Join surfaces over borders", unit: "", of: "all" },
  { name: "outline", words: "Separate and outline the buildings", unit: "", of: "all" },
  { name: "reconstruct", words: "Model the buildings", unit: "buildings", of: "models" },
  { name: "publish", words: "Write the results", unit: "tiles", of: "models" },
  { name: "octree", words: "Write the points", unit: "tiles", of: "points" },
  { name: "terrain", words: "Write the terrain", unit: "tiles", of: "terrain" },
  { name: "formats", words: "Write other formats", unit: "formats", of: "formats" },
  { name: "records", words: "Compare the runs", unit: "", of: "compare" },
  { name: "points", words: "Read points for the pictures", unit: "", of: "compare" },
  { name: "pictures", words: "Draw the pictures", unit: "", of: "compare" },
  { name: "page", words: "Write the page", unit: "", of: "compare" },
  { name: "classify", words: "Classify the points", unit: "tiles", of: "classify" },
  { name: "write", words: "Write the files", unit: "files", of: "classify" },
  { name: "rasters", words: "Draw the rasters", unit: "tiles", of: "classify" },
  { name: "mosaics", words: "Join the rasters", unit: "", of: "classify" },
  { name: "outputs", words: "Assemble the downloads", unit: "", of: "all" },
];

/** The stages of a job; none for one that has none. */
export function stagesOf({ processID, request }: StatusInfo): Stage[] {
  const { points, publish, settings } = (request?.inputs ?? {}) as { points?: boolean; publish?: string[]; settings?: { terrain?: string } };
  const isModel = processID !== "classify" && processID !== "compare";
  const has: Record<Kind, boolean> = {
    all: processID !== "echo",
    models: processID !== "classify" && processID !== "echo",
    points: isModel && points === true,
    terrain: isModel && settings?.terrain === "tin",
    formats: isModel && (publish ?? []).length > 0,
    compare: processID === "compare",
    classify: processID === "classify",
    compile: false,
  };
  return STAGES.filter(({ of }) => has[of]);
}

/** A stage by its name; one that is not known is shown by its name. */
export function stageNamed(name: string): Stage {
  return STAGES.find((stage) => stage.name === name) ?? { name, words: name, unit: "" };
}
