/** The objects of a run as they arrive: the candidates, and once they are wanted those that were left out. */

import { getJson, partOf, runReport, type Run } from "../api/requests";
import type { Feature, RunReport } from "../api/types";
import type { Category } from "../words/roof_types";
import type { Gathered, Listed } from "./batching";
import type { SceneFrame } from "./building_mesh";
import { loadModels, type FromLoading } from "./model_loading";
import { ringsOf } from "./plan";
import { modelUnits } from "./units";

export class RunObjects implements Run {
  readonly listed: Listed[] = [];
  /** Objects by category; those that were left out as the report counts them. */
  readonly counts = new Map<Category, number>();
  report: RunReport = {};
  private readonly byId = new Map<string, Listed>();
  private origin: readonly [number, number, number] | null = null;

  /** @param method The run of a comparison; null for other jobs. */
  constructor(
    readonly jobPath: string,
    readonly method: string | null,
  ) {}

  /** The scene in the coordinates of the job. */
  get frame(): SceneFrame {
    return { origin: this.origin ?? [0, 0, 0], ...modelUnits(this.report.crs) };
  }

  find(id: string): Listed | undefined {
    return this.byId.get(id);
  }

  add(listed: readonly Listed[]): void {
    for (const object of listed) {
      this.listed.push(object);
      this.byId.set(object.id, object);
      if (object.category !== "rejected") this.counts.set(object.category, (this.counts.get(object.category) ?? 0) + 1);
    }
  }

  async readReport(signal: AbortSignal): Promise<void> {
    this.report = await runReport(this, signal);
    this.counts.set("rejected", this.report.counts?.["rejected"] ?? 0);
  }

  /** Read the models at a level of detail, null for the finest of each; returns the available levels. */
  readModels(lod: string | null, onBuildings: (buildings: Gathered) => void, signal: AbortSignal): Promise<string[]> {
    const onMessage = (message: FromLoading): void => {
      if (message.kind === "frame" && lod === null) this.origin = message.origin;
      if (message.kind === "buildings") onBuildings(message);
    };
    return loadModels(partOf(this, "results/cityjson"), { ...modelUnits(this.report.crs), lod }, onMessage, signal);
  }

  /** Buildings without a model: only the records have their place. */
  async failed(signal: AbortSignal): Promise<Feature[]> {
    const path = partOf(this, "buildings?status=failed&limit=10000&crs=native");
    const { features } = await getJson<{ features: Feature[] }>(path, { signal, headers: { Accept: "application/geo+json" } });
    this.origin ??= cornerOf(features);
    return features;
  }

  /** Read the objects that were left out. */
  async readRejected(signal: AbortSignal): Promise<Feature[]> {
    const { rejectedObjects } = await import("./rejected_objects");
    const features = await rejectedObjects(this, signal);
    this.origin ??= cornerOf(features);
    return features;
  }
}

/** A corner of the first outline, rounded: the scene is drawn about it, since large coordinates lose digits. */
function cornerOf(features: readonly Feature[]): [number, number, number] | null {
  const corner = features.flatMap(({ geometry }) => ringsOf(geometry))[0]?.[0];
  return corner === undefined ? null : [Math.round(corner[0]), Math.round(corner[1]), 0];
}
