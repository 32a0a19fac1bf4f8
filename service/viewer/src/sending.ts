/** Sends files: small ones by one request, large ones so that they survive a lost network and a reload of the page. */

import { type UploadInfo, unreachable, upload } from "./api";

/** Files up to this size go again within seconds over a connection of 10 Mbit/s. */
export const SMALL_BYTES = 8_000_000;

/** Hears how far a file is. */
export interface Report {
  /** The share that has left this machine, 0 to 1. */
  progress(share: number): void;
  /** Why nothing is sent at the moment; null if it is. */
  waiting(reason: string | null): void;
}

/**
 * Send a file.
 *
 * @throws Problem when it is refused, AbortError when it is cancelled.
 */
export async function send(file: File, report: Report, signal: AbortSignal): Promise<UploadInfo> {
  if (file.size <= SMALL_BYTES) return upload(file, (share) => report.progress(share), signal);
  const { sendResumably } = await import("./resumable").catch(() => {
    throw unreachable();
  });
  return sendResumably(file, report, signal);
}
