/** The uploads of this browser that were not sent to their end; their files are to be chosen again. */

import { el } from "../page/elements";
import { bytes } from "../words/numbers";
import { fingerprint, forget, interrupted, keyOf } from "./interrupted";
import { fileHead } from "./sent_file";

export class Unfinished {
  readonly element = el("ul", { class: "files", "aria-label": "Interrupted uploads" });
  private readonly taken = new Set<string>();

  constructor() {
    void this.offer();
  }

  /** A file was chosen: it does not wait any longer. */
  take(file: File): void {
    const key = keyOf(fingerprint(file));
    this.taken.add(key);
    for (const row of [...this.element.children]) if (row instanceof HTMLElement && row.dataset["key"] === key) row.remove();
  }

  private async offer(): Promise<void> {
    for (const { key, name, size, offset } of await interrupted()) {
      if (this.taken.has(key)) continue;
      const remove = (): void => {
        row.remove();
        void forget(key);
      };
      const row = el(
        "li",
        { class: "file" },
        fileHead(name, size, `Forget ${name}`, remove),
        el("progress", { max: 1, value: offset / size, "aria-label": `Upload of ${name}` }),
        el("p", { class: "facts" }, `${bytes(offset)} of ${bytes(size)} are sent. Choose the file again to continue.`),
      );
      row.dataset["key"] = key;
      this.element.append(row);
    }
  }
}
