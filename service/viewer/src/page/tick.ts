import { count } from "../words/numbers";
import { el, type Properties } from "./elements";

/** A checkbox with signs of what it stands for, a label and a number. */
export class Tick {
  readonly row: HTMLElement;
  readonly box: HTMLInputElement;
  private readonly tally = el("span", { class: "tally" });

  constructor(label: string, onToggle: (on: boolean) => void, signs: readonly HTMLElement[] = [], properties: Properties = {}) {
    this.box = el("input", { type: "checkbox", onchange: () => onToggle(this.box.checked) });
    this.row = el("label", properties, this.box, ...signs, el("span", { class: "legend-label" }, label), this.tally);
  }

  /** @param n Its number; null for none. */
  set(checked: boolean, n: number | null, partly = false): void {
    this.box.checked = checked;
    this.box.indeterminate = partly;
    this.tally.textContent = n === null ? "" : count(n);
  }
}
