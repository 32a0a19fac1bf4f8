/** A file of the form: it is sent at once, and its row shows how far it is and what the service found in it. */

import { unreachable, type Problem } from "../api/requests";
import type { UploadInfo } from "../api/types";
import { el } from "../page/elements";
import { announce, asProblem, problemNotice, warningNotice } from "../page/notices";
import { capital } from "../words/fields";
import { bytes, count, measure, placeWords } from "../words/numbers";

/** Files up to this size are sent within seconds: how far they are needs no words. */
const SMALL_BYTES = 8_000_000;

/** The calls of a file to its form. */
export interface FileHooks {
  /** It is sent, or refused. */
  onEnd: () => void;
  onRemove: () => void;
  onProblem: (problem: Problem) => void;
}

export class SentFile {
  readonly row = el("li", { class: "file" });
  /** What the service says of it; null until all is sent. */
  uploaded: UploadInfo | null = null;
  /** Why it was refused. */
  problem: Problem | null = null;
  private readonly calledOff = new AbortController();
  private share = 0;
  /** Why nothing is sent at the moment. */
  private waiting: string | null = null;

  constructor(
    readonly file: File,
    private readonly hooks: FileHooks,
  ) {
    this.draw();
    void this.send();
  }

  /** What the service found in the header; nothing until all is sent. */
  get preflight(): Readonly<Record<string, unknown>> {
    return this.uploaded?.preflight ?? {};
  }

  /** Problems that the service found in the header. */
  get faults(): string[] {
    return texts(this.preflight["problems"]);
  }

  /** Call it off. */
  stop(): void {
    this.calledOff.abort();
  }

  private remove(): void {
    this.stop();
    this.row.remove();
    this.hooks.onRemove();
  }

  private async send(): Promise<void> {
    const { file } = this;
    const report = {
      progress: (share: number): void => {
        this.share = share;
        this.draw();
      },
      waiting: (reason: string | null): void => {
        if (reason === this.waiting) return;
        this.waiting = reason;
        announce(reason === null ? `${file.name} is being sent.` : `${file.name}: ${reason}`);
        this.draw();
      },
    };
    try {
      // the library of uploads is loaded only if there is something to send
      const { send } = await import("./resumable").catch(() => Promise.reject(unreachable()));
      this.uploaded = await send(file, report, this.calledOff.signal);
      announce(`${file.name} is uploaded. ${this.faults.join(" ")}`);
    } catch (error) {
      if (this.calledOff.signal.aborted) return;
      this.problem = asProblem(error);
      this.hooks.onProblem(this.problem);
    }
    this.draw();
    this.hooks.onEnd();
  }

  private draw(): void {
    const { file, uploaded, problem, row } = this;
    const head = fileHead(file.name, file.size, `Remove ${file.name}`, () => this.remove());
    if (problem !== null) {
      row.replaceChildren(head, problemNotice(problem));
    } else if (uploaded !== null) {
      row.replaceChildren(head, ...foundWords(uploaded.preflight));
    } else {
      // keep the same element: screen readers and transitions keep their place
      const bar = row.querySelector("progress") ?? el("progress", { max: 1, "aria-label": `Upload of ${file.name}` });
      bar.value = this.share;
      const words = row.querySelector(".sent") ?? el("p", { class: "facts sent" });
      words.textContent = this.waiting ?? sentWords(file.size, this.share);
      if (!bar.isConnected) row.replaceChildren(head, bar, ...(file.size > SMALL_BYTES ? [words] : []));
    }
  }
}

/** Name and size of a file, with a button that removes it. */
export function fileHead(name: string, size: number, removal: string, remove: () => void): HTMLElement {
  return el(
    "div",
    { class: "file-head" },
    el("span", { class: "file-name" }, name),
    el("span", { class: "file-size" }, bytes(size)),
    el("button", { type: "button", class: "icon", "aria-label": removal, onclick: remove }, "×"),
  );
}

/** Those of the entries of a list that are texts. */
export function texts(value: unknown): string[] {
  return Array.isArray(value) ? value.filter((entry) => typeof entry === "string") : [];
}

function sentWords(size: number, share: number): string {
  return share < 1 ? `${bytes(size * share)} of ${bytes(size)} are sent` : "All is sent, it is being examined";
}

/** The facts that the service read in the header. */
function foundWords(known: Readonly<Record<string, unknown>>): HTMLElement[] {
  const crs = known["crs"] as { name?: string; epsg?: number | null } | null | undefined;
  const crsText = crs == null ? "no CRS" : crs.epsg == null ? (crs.name ?? "CRS without a code") : `EPSG:${crs.epsg}`;
  const facts =
    known["kind"] !== "points"
      ? [typeof known["featureCount"] === "number" ? `${count(known["featureCount"])} ${known["kind"] === "guides" ? "lines" : "outlines"}` : null, crsText]
      : [
          typeof known["pointCount"] === "number" ? `${count(known["pointCount"])} points` : null,
          typeof known["densityPerM2"] === "number" ? measure(known["densityPerM2"], 1, "per m²") : null,
          crsText,
        ];
  const notes = [...texts(known["problems"]), ...texts(known["warnings"])].map(capital);
  const place = placeWords(known["place"]);
  return [
    el("p", { class: "facts", title: crs?.name ?? null }, facts.filter((fact) => fact !== null).join(" · ")),
    place === null ? null : el("p", { class: "place" }, `Lies at ${place}`),
    notes.length === 0 ? null : warningNotice(...notes),
  ].filter((part) => part !== null);
}
