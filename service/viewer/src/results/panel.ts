/** The panel beside the models: the list of objects, or the record of one of them. */

import { button, el } from "../page/elements";
import type { BuildingList } from "./building_list";

export class Panel {
  readonly element: HTMLElement;
  private readonly listView: HTMLElement;
  private stopRecord: () => void = () => undefined;

  /** @param open Goes to the record of an object, null for the list. */
  constructor(
    filters: HTMLElement,
    private readonly list: BuildingList,
    private readonly open: (id: string | null) => void,
  ) {
    this.listView = el("div", { class: "list" }, filters, list.element);
    this.element = el("aside", { class: "panel", "aria-label": "Buildings" }, this.listView);
  }

  /** Show the list; the row of the object that was shown gets the focus. */
  showList(before: string | null): void {
    this.leave();
    this.element.replaceChildren(this.listView);
    this.list.returned();
    this.list.focus(before);
  }

  /**
   * Show the record of an object.
   *
   * @param isClicked It was clicked in the view.
   * @param wasList The list was shown before.
   * @param fill Fills the panel; returns a function that ends it.
   */
  showRecord(id: string, isClicked: boolean, wasList: boolean, fill: (body: HTMLElement) => () => void): void {
    this.leave();
    const step = (by: number) => () => {
      const next = this.list.beside(id, by);
      if (next !== null) this.open(next);
    };
    const back = button("← All buildings", () => this.open(null), { class: "quiet" });
    const body = el("div", { class: "record", "aria-live": "polite" });
    this.element.replaceChildren(
      el(
        "div",
        { class: "record-bar" },
        back,
        el("span", { class: "spacer" }),
        button("‹", step(-1), { class: "quiet", "aria-label": "Previous building" }),
        button("›", step(1), { class: "quiet", "aria-label": "Next building" }),
      ),
      body,
    );
    this.element.scrollTop = 0;
    if (isClicked) this.element.scrollIntoView({ block: "nearest" }); // on narrow screens it is below the models
    else if (wasList) back.focus({ preventScroll: true });
    this.stopRecord = fill(body);
  }

  /** Stop what loads. */
  leave(): void {
    this.stopRecord();
    this.stopRecord = () => undefined;
  }
}
