/** The uploads of this browser that were not sent to their end; their files are to be chosen again. */

import { el } from "../page/elements";
import { bytes } from "../words/numbers";
import { forget, interrupted, keyOf } from "./interrupted";
import { fileHead } from "./sent_file";

export class Unfinished {
  readonly element = el("ul", { class: "files", "aria-label": "Interrupted uploads" });
  /** Rows by the keys of their uploads. */
  private readonly rows = new Map<string, HTMLElement>();
  /** The keys of chosen files. */
  private readonly taken = new Set<string>();

  constructor() {
    void this.offer();
  }

  /** A file was chosen: it does not wait any longer. */
  take(file: File): void {
    this.taken.add(keyOf(file));
    this.rows.get(keyOf(file))?.remove();
  }

  private async offer(): Promise<void> {
    for (const one of await interrupted()) {
      const { key, name, size, offset } = one;
      if (this.taken.has(key)) continue;
      const remove = (): void => {
        row.remove();
        void forget(one);
      };
      const row = el(
        "li",
        { class: "file" },
        fileHead(name, size, `Forget ${name}`, remove),
        el("progress", { max: 1, value: offset / size, "aria-label": `Upload of ${name}` }),
        el("p", { class: "facts" }, `${bytes(offset)} of ${bytes(size)} are sent. Choose the file again to continue.`),
      );
      this.rows.set(key, row);
      this.element.append(row);
    }
  }
}
