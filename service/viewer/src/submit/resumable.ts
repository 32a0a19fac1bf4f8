/** Sends files by tus: what has arrived is kept, so that they survive a lost network and a reload of the page. */

import { Upload, type DetailedError } from "tus-js-client";
import { authorization, getJson, Problem, problemOf, serviceUrl } from "../api/requests";
import type { Preflight, UploadInfo } from "../api/types";
import { drop, kept, keyOf, placeOf, remember } from "./interrupted";

/** Gets how far a file is. */
export interface ProgressReport {
  /** The share that has left this machine, 0 to 1. */
  progress(share: number): void;
  /** Why nothing is sent at the moment; null if it is. */
  waiting(reason: string | null): void;
}

/** Before each further attempt, until one sends a byte; the last pause is repeated for a day. */
const PAUSES_MS = [0, 1000, 3000, 5000, ...new Array<number>(10_000).fill(10_000)];
/** Answers of a service in trouble that may pass; others would be the same again. */
const PASSING = new Set([409, 423, 429, 500, 502, 503, 504]);
/** Refusals in a row, without a byte in between, after which the upload fails. */
const MOST_REFUSALS = 12;
/** Refusals after which the service has nothing of the file. */
const GONE = new Set([400, 404, 410, 413, 415, 422]);

/**
 * Send a file.
 *
 * @throws Problem when it is refused, AbortError when it is cancelled.
 */
export function send(file: File, report: ProgressReport, signal: AbortSignal): Promise<UploadInfo> {
  return new Promise((resolve, reject) => {
    new Sending(file, report, signal, resolve, reject).begin();
  });
}

class Sending {
  private readonly upload: Upload;
  private readonly key: string;
  private isOver = false;

  constructor(
    private readonly file: File,
    private readonly report: ProgressReport,
    private readonly signal: AbortSignal,
    private readonly resolve: (uploaded: UploadInfo) => void,
    private readonly reject: (reason: unknown) => void,
  ) {
    this.key = keyOf(file);
    this.upload = new Upload(file, {
      endpoint: serviceUrl("uploads/tus"),
      metadata: { filename: file.name },
      // the library would also forget an upload for which a key is missing
      storeFingerprintForResuming: false,
      retryDelays: PAUSES_MS,
      onShouldRetry: (error, attempt) => this.mayPass(error, attempt),
      onBeforeRequest: (request) => {
        for (const [name, value] of Object.entries(authorization())) request.setHeader(name, value);
      },
      onUploadUrlAvailable: () => this.settle(this.upload.url),
      onProgress: (sent, total) => {
        report.waiting(null);
        report.progress(total > 0 ? sent / total : 0);
      },
      onSuccess: () => void this.finish(),
      onError: (error) => this.fail(error),
    });
  }

  begin(): void {
    this.signal.addEventListener("abort", () => this.callOff());
    this.settle(kept(this.key)?.url ?? null);
    if (this.signal.aborted) this.callOff();
    else this.upload.start();
  }

  /** From now on there is an upload, unless the address is null: a failed look at it must not begin another one. */
  private settle(url: string | null): void {
    if (url === null) return;
    remember(this.file, url);
    this.upload.url = serviceUrl(placeOf(url));
    this.upload.options.endpoint = null;
  }

  /** Whether a failure may pass by itself: then it is tried again. */
  private mayPass({ originalResponse: answer }: DetailedError, attempt: number): boolean {
    const status = answer?.getStatus() ?? 0;
    const isRefused = status !== 423 && attempt >= MOST_REFUSALS;
    if (status !== 0 && (isRefused || !PASSING.has(status))) return false;
    if (status === 0) void this.checkFile();
    const reason = status === 0 ? "The service does not answer." : status === 423 ? "Another page sends it." : "The service is busy.";
    this.report.waiting(`${reason} It continues by itself.`);
    return true;
  }

  /** End if the file is no longer what was chosen: browsers report that like a lost network. */
  private async checkFile(): Promise<void> {
    try {
      await this.file.slice(0, 1).arrayBuffer();
    } catch {
      void this.upload.abort();
      this.reject(new Problem(0, "The file cannot be read", `${this.file.name} was moved, removed or changed.`, "Choose it again."));
    }
  }

  private fail(error: Error | DetailedError): void {
    const answer = "originalResponse" in error ? error.originalResponse : null;
    const status = answer?.getStatus() ?? 0;
    if (GONE.has(status)) drop(this.key);
    if (this.upload.url !== null && (status === 404 || status === 410)) {
      // it has expired, or belongs to another key
      this.upload.url = null;
      this.upload.options.endpoint = serviceUrl("uploads/tus");
      this.upload.start();
      return;
    }
    this.isOver = true;
    this.reject(answer == null ? error : problemOf(status, "", answer.getBody(), answer.getHeader("Retry-After") ?? null));
  }

  private async finish(): Promise<void> {
    this.isOver = true;
    drop(this.key);
    try {
      const place = placeOf(this.upload.url ?? "").replace("/tus/", "/");
      const { preflight } = await getJson<{ preflight: Preflight }>(place);
      this.resolve({ href: serviceUrl(place), preflight });
    } catch (error) {
      this.reject(error);
    }
  }

  private callOff(): void {
    if (this.isOver) return; // a file that has arrived stays on the service
    // also on the service; if it does not answer, the upload expires
    void this.upload.abort(true).catch(() => null);
    drop(this.key);
    this.reject(new DOMException("cancelled", "AbortError"));
  }
}
