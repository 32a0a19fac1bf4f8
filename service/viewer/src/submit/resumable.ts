/** Large files, by tus: what has arrived is kept. This module and its library are loaded when such a file is sent. */

import { Upload, type DetailedError } from "tus-js-client";
import { authorization, getJson, Problem, problemOf, serviceUrl } from "../api/requests";
import type { Preflight, UploadInfo } from "../api/types";
import { fingerprint, keyOf, memory, placeOf } from "./interrupted";

/** Gets how far a file is. */
export interface ProgressReport {
  /** The share that has left this machine, 0 to 1. */
  progress(share: number): void;
  /** Why nothing is sent at the moment; null if it is. */
  waiting(reason: string | null): void;
}

const PAUSES_S = [0, 1, 3, 5, 10];
/** Answers of a service in trouble that may pass; others would be the same again. */
const PASSING = new Set([409, 423, 429, 500, 502, 503, 504]);
/** Refusals in a row, without a byte in between, after which they count. */
const PATIENCE = 12;
/** Refusals after which the service has nothing of the file. */
const GONE = new Set([400, 404, 410, 413, 415, 422]);

/** As `send`. */
export function sendResumably(file: File, report: ProgressReport, signal: AbortSignal): Promise<UploadInfo> {
  return new Promise((resolve, reject) => {
    new Sending(file, report, signal, resolve, reject).begin().catch(reject);
  });
}

class Sending {
  private readonly upload: Upload;
  private fails = 0;
  private isPaused = false;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private readonly listening = new AbortController();
  private readonly mark: string;

  constructor(
    private readonly file: File,
    private readonly report: ProgressReport,
    private readonly signal: AbortSignal,
    private readonly resolve: (uploaded: UploadInfo) => void,
    private readonly reject: (reason: unknown) => void,
  ) {
    this.mark = fingerprint(file);
    this.upload = new Upload(file, {
      endpoint: serviceUrl("uploads/tus"),
      metadata: { filename: file.name },
      fingerprint: async () => this.mark,
      // the library would forget an upload for which a key is missing
      urlStorage: { ...memory, removeUpload: async () => undefined },
      // the pauses are ours: they end when the network is back, and never for good
      retryDelays: null,
      onBeforeRequest: (request) => {
        for (const [name, value] of Object.entries(authorization())) request.setHeader(name, value);
      },
      onUploadUrlAvailable: () => this.settle(),
      onProgress: (sent, total) => {
        this.fails = 0;
        report.waiting(null);
        report.progress(total > 0 ? sent / total : 0);
      },
      onSuccess: () => void this.finish(),
      onError: (error) => void this.fail(error),
    });
  }

  async begin(): Promise<void> {
    const options = { signal: this.listening.signal };
    this.signal.addEventListener("abort", () => this.callOff(), options);
    window.addEventListener("offline", () => this.pause("The network is away."), options);
    window.addEventListener("online", () => this.go(), options);
    const [known] = await memory.findUploadsByFingerprint(this.mark);
    if (known !== undefined) this.upload.resumeFromPreviousUpload(known);
    if (known?.uploadUrl != null) this.settle();
    if (!this.signal.aborted) this.upload.start();
  }

  /** From now on there is an upload: a failed look at it must not begin another one. */
  private settle(): void {
    if (this.upload.url !== null) this.upload.url = serviceUrl(placeOf(this.upload.url));
    this.upload.options.endpoint = null;
  }

  private go(): void {
    clearTimeout(this.timer);
    if (!this.isPaused || this.signal.aborted) return;
    this.isPaused = false;
    this.upload.start();
  }

  /** Stop sending; without a time it goes on when the network is back. */
  private pause(reason: string, pauseS?: number): void {
    clearTimeout(this.timer);
    this.isPaused = true;
    void this.upload.abort();
    this.report.waiting(`${reason} It continues by itself.`);
    if (pauseS !== undefined) this.timer = setTimeout(() => this.go(), pauseS * 1000);
  }

  private async fail(error: Error | DetailedError): Promise<void> {
    if (this.signal.aborted) return;
    const answer = "originalResponse" in error ? error.originalResponse : null;
    const status = answer?.getStatus() ?? 0;
    if (this.upload.url !== null && (status === 404 || status === 410)) {
      // it has expired, or belongs to another key
      await memory.removeUpload(keyOf(this.mark));
      this.upload.url = null;
      this.upload.options.endpoint = serviceUrl("uploads/tus");
      this.upload.start();
      return;
    }
    if (status === 0 && !(await isReadable(this.file))) {
      this.end(new Problem(0, "The file cannot be read", `${this.file.name} was moved, removed or changed.`, "Choose it again."));
      return;
    }
    this.fails += 1;
    const isPatient = status === 0 || status === 423 || this.fails <= PATIENCE;
    if (status !== 0 && !(PASSING.has(status) && isPatient)) {
      if (GONE.has(status)) await memory.removeUpload(keyOf(this.mark));
      const retryAfter = answer?.getHeader("Retry-After") ?? null;
      this.end(problemOf(status, "", answer?.getBody() ?? "", retryAfter));
      return;
    }
    const reason = status === 0 ? "The service does not answer." : status === 423 ? "Another page sends it." : "The service is busy.";
    this.pause(reason, PAUSES_S[Math.min(this.fails, PAUSES_S.length) - 1]);
  }

  private async finish(): Promise<void> {
    this.listening.abort();
    await memory.removeUpload(keyOf(this.mark));
    try {
      const place = placeOf(this.upload.url ?? "").replace("/tus/", "/");
      const { preflight } = await getJson<{ preflight: Preflight }>(place);
      this.resolve({ href: serviceUrl(place), preflight });
    } catch (error) {
      this.reject(error);
    }
  }

  private callOff(): void {
    clearTimeout(this.timer);
    // also on the service; if it does not answer, the upload expires
    void this.upload.abort(true).catch(() => null);
    void memory.removeUpload(keyOf(this.mark));
    this.end(new DOMException("cancelled", "AbortError"));
  }

  private end(reason: unknown): void {
    this.listening.abort();
    this.reject(reason);
  }
}

async function isReadable(file: File): Promise<boolean> {
  try {
    await file.slice(0, 1).arrayBuffer();
    return true;
  } catch {
    return false;
  }
}
