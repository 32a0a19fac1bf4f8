/** The stages of a job in their order, with the unit that is counted. */

import type { StatusInfo } from "../api/types";
import { TABLES, type Stage } from "../words/tables";

export type { Stage };

/** The stages of a job; none for one that has none. */
export function stagesOf({ processID, request }: StatusInfo): Stage[] {
  const { points, publish, settings } = (request?.inputs ?? {}) as { points?: boolean; publish?: string[]; settings?: { terrain?: string } };
  const isModel = processID !== "classify" && processID !== "compare";
  const has: Record<string, boolean> = {
    all: processID !== "echo",
    models: processID !== "classify" && processID !== "echo",
    points: isModel && points === true,
    terrain: isModel && settings?.terrain === "tin",
    formats: isModel && (publish ?? []).length > 0,
    compare: processID === "compare",
    classify: processID === "classify",
  };
  return TABLES.stages.filter(({ of }) => has[of]);
}

/** A stage by its name; one that is not known is shown by its name. */
export function stageNamed(name: string): Stage {
  return TABLES.stages.find((stage) => stage.name === name) ?? { name, words: name, unit: "", of: "" };
}
