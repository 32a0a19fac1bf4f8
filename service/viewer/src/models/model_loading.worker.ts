/** Reads and triangulates the models in a worker, which keeps the page responsive. It fetches nothing itself. */

import { jsonLines } from "../api/json_lines";
import { Batcher } from "./batching";
import { SequenceReader, type Building } from "./cityjson";
import type { FromLoading, Reading, ToLoading } from "./loading_messages";

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
  const early: Building[] = []; // those without a vertex, before the origin is known
  let batcher: Batcher | null = null;
  let listed: ReturnType<Batcher["add"]>[] = [];
  let size = FIRST_BATCH;
  const give = (): void => {
    if (batcher === null) return;
    const batches = batcher.take();
    const outlines = batcher.takeOutlines();
    tell({ kind: "buildings", listed, batches, outlines }, [...batches.flatMap(buffersOf), ...outlineBuffers(outlines)]);
    listed = [];
  };
  for await (const line of jsonLines(arriving())) {
    const building = reader.read(line);
    if (building === null) continue;
    if (batcher === null && building.vertices.length === 0) {
      early.push(building);
      continue;
    }
    if (batcher === null) {
      const origin = originOf(reader, building);
      batcher = new Batcher({ origin, horizontalUnitM, verticalUnitM });
      tell({ kind: "frame", origin });
    }
    listed.push(batcher.add(building));
    if (listed.length >= size) {
      give();
      size *= 2;
    }
  }
  batcher ??= new Batcher({ origin: [0, 0, 0], horizontalUnitM, verticalUnitM });
  for (const building of early) listed.push(batcher.add(building));
  give();
  tell({ kind: "finished", levels: reader.levels });
}

/** Whole units in the middle of all models, or at the first one's corner. */
function originOf(reader: SequenceReader, { vertices }: Building): [number, number, number] {
  const extent = reader.metadata?.extent;
  if (extent?.length === 6) {
    return [Math.round((extent[0] + extent[3]) / 2), Math.round((extent[1] + extent[4]) / 2), Math.floor(extent[2])];
  }
  return [Math.round(vertices[0]), Math.round(vertices[1]), Math.floor(vertices[2])];
}

function buffersOf(batch: ReturnType<Batcher["take"]>[number]): Transferable[] {
  return [
    batch.starts.buffer,
    batch.edgeStarts.buffer,
    batch.boxes.buffer,
    batch.positions.buffer,
    batch.normals.buffer,
    batch.surfaces.buffer,
    batch.edges.buffer,
  ];
}

function outlineBuffers({ shapeStarts, ringStarts, xy }: ReturnType<Batcher["takeOutlines"]>): Transferable[] {
  return [shapeStarts.buffer, ringStarts.buffer, xy.buffer];
}

function tell(message: FromLoading, transfer: Transferable[] = []): void {
  self.postMessage(message, { transfer });
}
