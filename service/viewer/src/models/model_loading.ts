import { chunks } from "../api/lines";
import { request } from "../api/requests";
import type { FromLoading, Reading, ToLoading } from "./model_loading.worker";

export type { FromLoading };

/**
 * Fetches models and reads them in a worker.
 *
 * The page fetches, since a worker's own requests are bound by the policy that its script was sent with.
 *
 * @returns The levels of detail to choose from, coarse to fine; empty if each building has one.
 * @throws Problem if they cannot be fetched, Error if they cannot be read, AbortError if cancelled.
 */
export async function loadModels(
  path: string,
  reading: Reading,
  onMessage: (message: FromLoading) => void,
  signal: AbortSignal,
): Promise<string[]> {
  const response = await request(path, { headers: { Accept: "application/city+json-seq" }, signal });
  const worker = new Worker(new URL("./model_loading.worker.ts", import.meta.url), { type: "module" });
  try {
    const read = new Promise<string[]>((resolve, reject) => {
      worker.onmessage = ({ data }: MessageEvent<FromLoading>) => {
        if (data.kind === "failed") reject(new Error(data.detail));
        else if (data.kind === "finished") resolve(data.levels);
        else if (!signal.aborted) onMessage(data);
      };
      worker.onerror = (event) => reject(new Error(event.message || "the reader of the models could not start"));
      signal.addEventListener("abort", () => reject(new DOMException("cancelled", "AbortError")));
    });
    const [levels] = await Promise.all([read, send(chunks(response.body), reading, worker)]);
    return levels;
  } finally {
    worker.terminate();
  }
}

async function send(body: AsyncIterable<Uint8Array>, reading: Reading, worker: Worker): Promise<void> {
  for await (const bytes of body) worker.postMessage({ ...reading, bytes } satisfies ToLoading);
  worker.postMessage({ ...reading, bytes: null } satisfies ToLoading);
}
