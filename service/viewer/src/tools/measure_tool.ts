import type { Vector3 } from "three";
import { button, el, setPressed } from "../page/elements";
import { announce } from "../page/notices";
import { facts } from "../page/tables";
import type { Tool } from "../scene/layer";
import type { ModelScene } from "../scene/scene";
import { measure } from "../words/numbers";
import { MeasureDrawing } from "./measure_drawing";

const STEP_PX = 16; // of the cross, with an arrow key
const FINE_PX = 1; // the same with Shift

/** Measures between two places: two clicks or taps, or a cross that the arrow keys move and Enter sets. */
export class MeasureTool implements Tool {
  readonly button = button("Measure", () => this.toggle(), { title: "Measure distances and heights (m)", "aria-pressed": "false" });
  readonly card = el("section", { class: "stage-card measure", "aria-label": "Measurement", hidden: true });
  /** The place where the keyboard sets. */
  readonly cross = el("div", { class: "cross", "aria-hidden": "true", hidden: true });
  private readonly drawing = new MeasureDrawing();
  private places: Vector3[] = [];
  private at: [number, number] = [0.5, 0.5];
  private on = false;

  constructor(
    private readonly scene: ModelScene,
    private readonly canvas: HTMLCanvasElement,
  ) {}

  private toggle(): void {
    if (this.on) this.end();
    else this.begin();
  }

  /** Stop measuring and remove what is drawn. */
  end(): void {
    if (!this.on) return;
    this.on = false;
    this.places = [];
    this.scene.pointing.use(null);
    this.scene.removeLayer(this.drawing);
    document.removeEventListener("keydown", this.escaped, true);
    setPressed(this.button, false);
    this.card.hidden = this.cross.hidden = true;
    announce("Measuring has ended.");
  }

  clicked(place: Vector3 | null): void {
    this.cross.hidden = true;
    this.set(place);
  }

  hovered(place: Vector3 | null): void {
    if (this.places.length !== 1) return;
    this.drawing.show(place === null ? this.places : [this.places[0], place]);
    this.write(place === null ? this.places : [this.places[0], place]);
    this.scene.request();
  }

  typed(event: KeyboardEvent): boolean {
    if (event.ctrlKey || event.metaKey || event.altKey) return false;
    const move = ({ ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] } as Record<string, [number, number]>)[event.key];
    if (move !== undefined) {
      const { clientWidth, clientHeight } = this.canvas;
      const step = event.shiftKey ? FINE_PX : STEP_PX;
      if (!this.cross.hidden) {
        this.at = [held(this.at[0] + (step * move[0]) / clientWidth), held(this.at[1] + (step * move[1]) / clientHeight)];
      }
      this.showCross();
      this.hovered(this.underCross());
      return true;
    }
    if (event.key !== "Enter" && event.key !== " ") return false;
    this.showCross();
    this.set(this.underCross());
    return true;
  }

  private begin(): void {
    this.on = true;
    this.at = [0.5, 0.5];
    this.scene.pointing.use(this);
    this.scene.addLayer(this.drawing);
    document.addEventListener("keydown", this.escaped, true);
    setPressed(this.button, true);
    this.card.hidden = false;
    this.drawing.show([]);
    this.write([]);
    announce("Measuring. Click two places, or move the cross with the arrow keys and set it with Enter. Escape ends.");
    this.canvas.focus({ preventScroll: true });
  }

  private set(place: Vector3 | null): void {
    if (place === null) {
      announce("There is nothing to measure at this place.");
      return;
    }
    this.places = this.places.length === 1 ? [this.places[0], place] : [place];
    this.drawing.show(this.places);
    this.write(this.places);
    this.scene.request();
    const [from, to] = this.places;
    if (to === undefined) announce("First place set.");
    else announce(measured(from, to).map((pair) => pair.join(" ")).join(", "));
  }

  private write([from, to]: readonly Vector3[]): void {
    if (from === undefined || to === undefined) {
      const hint = from === undefined ? "Click or tap the first place" : "Now the second place";
      this.card.replaceChildren(el("p", {}, hint, el("span", { class: "hint" }, " · Esc ends")));
      return;
    }
    this.card.replaceChildren(facts({}, ...measured(from, to)));
  }

  private underCross(): Vector3 | null {
    const frame = this.canvas.getBoundingClientRect();
    return this.scene.placeAt(frame.left + this.at[0] * frame.width, frame.top + this.at[1] * frame.height);
  }

  private showCross(): void {
    this.cross.hidden = false;
    this.cross.style.left = `${100 * this.at[0]}%`;
    this.cross.style.top = `${100 * this.at[1]}%`;
  }

  /** Hears of Escape before the view, which would close the record, and before menus: a menu is still open then. */
  private readonly escaped = (event: KeyboardEvent): void => {
    if (event.key !== "Escape") return;
    const closesMenu = event.target instanceof Element && event.target.closest("details.menu[open]") !== null;
    if (closesMenu || document.querySelector("dialog[open]") !== null) return;
    event.preventDefault();
    event.stopPropagation();
    this.end();
    this.button.focus();
  };
}

function held(share: number): number {
  return Math.min(Math.max(share, 0), 1);
}

/** Distances between two places in metres, and the angle of the line above the horizontal. */
export function measured(from: Vector3, to: Vector3): [string, string][] {
  const horizontal = Math.hypot(to.x - from.x, to.y - from.y);
  const height = to.z - from.z;
  const sign = height > 0.005 ? "+" : "";
  return [
    ["Horizontal distance", measure(horizontal, 2, "m")],
    ["Height difference", sign + measure(height, 2, "m")],
    ["Slope distance", measure(from.distanceTo(to), 2, "m")],
    ["Inclination", measure((Math.atan2(height, horizontal) * 180) / Math.PI, 1, "°")],
  ];
}
