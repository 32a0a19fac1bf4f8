import type { Address } from "./address";
import { el } from "./elements";
import type { View } from "./view";
import { Watching } from "./watching";

/** One thing of the service on a sheet, which is read again while it may change. */
export abstract class WatchedPage<T> extends Watching implements View {
  protected readonly sheet = el("div", { class: "sheet" }, el("p", { class: "loading" }, "Loading…"), this.note);
  private shown = "";

  /**
   * @param title Its title until it is read.
   * @param back The way back to the list.
   */
  constructor(
    place: HTMLElement,
    title: string,
    private readonly back: HTMLElement,
    refreshMs: number,
  ) {
    super(refreshMs);
    document.title = `${title} · gablework`;
    place.replaceChildren(this.sheet);
  }

  follow(_address: Address): void {
    void this.load();
  }

  protected abstract get(signal: AbortSignal): Promise<T>;

  /** Its head, and what is below the way back. */
  protected abstract parts(found: T, isFirst: boolean): [HTMLElement, ...HTMLElement[]];

  protected abstract mayChange(found: T): boolean;

  protected async read(signal: AbortSignal): Promise<boolean> {
    try {
      const found = await this.get(signal);
      const state = JSON.stringify(found);
      // an open menu is not closed by a refresh
      if (!signal.aborted && state !== this.shown && this.sheet.querySelector("details[open]") === null) {
        const hadFocus = this.sheet.contains(document.activeElement) && document.activeElement?.tagName === "BUTTON";
        const [head, ...content] = this.parts(found, this.shown === "");
        this.shown = state;
        this.sheet.replaceChildren(head, this.back, this.note, ...content);
        if (hadFocus) head.querySelector("button")?.focus();
      }
      return this.mayChange(found);
    } catch (error) {
      if (!signal.aborted && this.shown === "") this.sheet.replaceChildren(this.back, this.note);
      throw error;
    }
  }
}
