/** Messages between the page and the worker that reads models. */

import type { Batch, Listed } from "./batching";
import type { Outlines } from "./outlines";

/** A piece of the CityJSONSeq for the worker. */
export interface ToLoading {
  /** Null at the end. */
  bytes: Uint8Array | null;
  /** Metres in a unit of the coordinates. */
  horizontalUnitM: number;
  verticalUnitM: number;
  /** The shown level of detail; null for the finest of each building. */
  lod: string | null;
}

/** How the models are read. */
export type Reading = Omit<ToLoading, "bytes">;

/** Messages of the worker. */
export type FromLoading =
  | { kind: "frame"; origin: [number, number, number] }
  | { kind: "buildings"; listed: Listed[]; batches: Batch[]; outlines: Outlines }
  /** The levels of detail to choose from, coarse to fine; empty if each building has one. */
  | { kind: "finished"; levels: string[] }
  | { kind: "failed"; detail: string };
