import { request } from "./api";
import type { Batch, Listed } from "./batching";
import { chunks } from "./json_lines";

/** A piece of the CityJSONSeq for the worker. */
export interface ToLoading {
  /** Null at the end. */
  bytes: Uint8Array | null;
  /** Metres in a unit of the coordinates. */
  horizontalUnitM: number;
  verticalUnitM: number;
}

/** What the worker tells. */
export type FromLoading =
  | { kind: "frame"; origin: [number, number, number] }
  | { kind: "buildings"; listed: Listed[]; batches: Batch[] }
  | { kind: "finished" }
  | { kind: "failed"; detail: string };

/**
 * Fetches models and has them read in a worker.
 *
 * The page fetches, since a worker's own requests are bound by the policy that its script was sent with.
 *
 * @throws Problem when they cannot be had, Error when they cannot be read, AbortError when called off.
 */
export async function loadModels(
  path: string,
  units: Pick<ToLoading, "horizontalUnitM" | "verticalUnitM">,
  onMessage: (message: FromLoading) => void,
  signal: AbortSignal,
): Promise<void> {
  const response = await request(path, { headers: { Accept: "application/city+json-seq" }, signal });
  if (response.body === null) throw new TypeError("the answer has no body");
  const worker = new Worker(new URL("./model_loading.worker.ts", import.meta.url), { type: "module" });
  try {
    const read = new Promise<void>((resolve, reject) => {
      worker.onmessage = ({ data }: MessageEvent<FromLoading>) => {
        if (data.kind === "failed") reject(new Error(data.detail));
        else if (data.kind === "finished") resolve();
        else if (!signal.aborted) onMessage(data);
      };
      worker.onerror = (event) => reject(new Error(event.message || "the reader of the models could not start"));
      signal.addEventListener("abort", () => reject(new DOMException("called off", "AbortError")));
    });
    const sent = send(response.body, units, worker);
    await Promise.all([sent, read]);
  } finally {
    worker.terminate();
  }
}

async function send(
  body: ReadableStream<Uint8Array>,
  units: Pick<ToLoading, "horizontalUnitM" | "verticalUnitM">,
  worker: Worker,
): Promise<void> {
  for await (const bytes of chunks(body)) worker.postMessage({ ...units, bytes } satisfies ToLoading);
  worker.postMessage({ ...units, bytes: null } satisfies ToLoading);
}
