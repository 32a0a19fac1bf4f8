/** Sends files: small ones by one request, large ones so that they survive a lost network and a reload of the page. */

import { unreachable, upload } from "../api/requests";
import type { UploadInfo } from "../api/types";
import type { ProgressReport } from "./resumable";

/** Files up to this size go again within seconds over a connection of 10 Mbit/s. */
export const SMALL_BYTES = 8_000_000;

/**
 * Send a file.
 *
 * @throws Problem when it is refused, AbortError when it is cancelled.
 */
export async function send(file: File, report: ProgressReport, signal: AbortSignal): Promise<UploadInfo> {
  if (file.size <= SMALL_BYTES) return upload(file, (share) => report.progress(share), signal);
  const { sendResumably } = await import("./resumable").catch(() => {
    throw unreachable();
  });
  return sendResumably(file, report, signal);
}
