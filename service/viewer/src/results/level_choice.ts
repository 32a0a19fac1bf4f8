import { levelWords } from "../models/levels_of_detail";
import { button, el, setPressed } from "../page/elements";

/** Buttons for the levels of detail of the shown models; hidden if there is nothing to choose. */
export class LevelChoice {
  readonly element = el("div", { class: "tool-group levels", role: "group", "aria-label": "Level of detail", hidden: true });

  constructor(private readonly onChoice: (lod: string) => void) {}

  /** Set the available levels, coarse to fine; the finest is shown. */
  offer(lods: readonly string[]): void {
    this.element.replaceChildren(
      ...lods.map((lod) =>
        button(`LoD${lod}`, () => this.onChoice(lod), { value: lod, title: levelWords(lod) }),
      ),
    );
    this.element.hidden = lods.length < 2;
    this.mark(lods[lods.length - 1] ?? "");
  }

  /** Mark the shown level. */
  mark(lod: string): void {
    for (const one of this.element.querySelectorAll("button")) setPressed(one, one.value === lod);
  }
}
