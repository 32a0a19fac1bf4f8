/** Reads and triangulates the models in a worker, which keeps the page responsive. It fetches nothing itself. */

import { jsonLines } from "../api/lines";
import { Batcher, type Gathered } from "./batching";
import { SequenceReader } from "./cityjson";

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
  | ({ kind: "buildings" } & Gathered)
  /** The levels of detail to choose from, coarse to fine; empty if each building has one. */
  | { kind: "finished"; levels: string[] }
  | { kind: "failed"; detail: string };

const FIRST_BATCH = 200; // buildings; each batch is twice as large: something to see at once, few batches in the end

const given: (Uint8Array | null)[] = [];
let wake: () => void = () => undefined;
let started = false;

self.onmessage = ({ data }: MessageEvent<ToLoading>) => {
  given.push(data.bytes);
  wake();
  if (started) return;
  started = true;
  read(data).catch((error: unknown) => {
    tell({ kind: "failed", detail: error instanceof Error ? error.message : String(error) });
  });
};

/** The text that the page passes in, until its end. */
async function* arriving(): AsyncGenerator<Uint8Array> {
  for (;;) {
    const bytes = given.shift();
    if (bytes === null) return;
    if (bytes !== undefined) yield bytes;
    else await new Promise<void>((resolve) => (wake = resolve));
  }
}

async function read({ horizontalUnitM, verticalUnitM, lod }: Reading): Promise<void> {
  const reader = new SequenceReader(lod);
  let batcher: Batcher | null = null;
  let size = FIRST_BATCH;
  for await (const line of jsonLines(arriving())) {
    const building = reader.read(line);
    if (building === null) continue;
    batcher ??= new Batcher({ origin: originOf(reader), horizontalUnitM, verticalUnitM });
    batcher.add(building);
    if (batcher.size >= size) {
      give(batcher);
      size *= 2;
    }
  }
  if (batcher !== null) give(batcher);
  tell({ kind: "finished", levels: reader.levels });
}

/** Whole units in the middle of all models; without models their place does not matter. */
function originOf({ extent }: SequenceReader): [number, number, number] {
  if (extent === null) return [0, 0, 0];
  const origin: [number, number, number] = [
    Math.round((extent[0] + extent[3]) / 2),
    Math.round((extent[1] + extent[4]) / 2),
    Math.floor(extent[2]),
  ];
  tell({ kind: "frame", origin });
  return origin;
}

/** Give what is read to the page; the arrays of the batches are handed over and not copied. */
function give(batcher: Batcher): void {
  const taken = batcher.take();
  const values = taken.batches.flatMap((batch) => Object.values(batch) as unknown[]);
  const buffers = values.filter(ArrayBuffer.isView).map(({ buffer }) => buffer as ArrayBuffer);
  tell({ kind: "buildings", ...taken }, buffers);
}

function tell(message: FromLoading, transfer: Transferable[] = []): void {
  self.postMessage(message, { transfer });
}
