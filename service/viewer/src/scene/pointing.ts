/** Clicks, moves and keys in the view: they select buildings, or a tool takes them. */

import { Vector2, type Vector3 } from "three";
import { onKeys } from "../page/elements";
import type { Tool } from "./layer";

const CLICK_PX = 5; // farther is a drag

/** What the pointer may mean, by a place of the page. */
export interface Targets {
  buildingAt(clientX: number, clientY: number): string | null;
  placeAt(clientX: number, clientY: number): Vector3 | null;
}

export class Pointing {
  private tool: Tool | null = null;
  private hovered: string | null = null;
  private readonly down = new Vector2();
  private pointer: PointerEvent | null = null;

  /**
   * @param onPick Gets the building that was clicked, null for a click beside all of them.
   * @param keys What keys do; a tool may take them first.
   * @param request Asks for a frame, which calls `update`.
   */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly targets: Targets,
    private readonly onPick: (id: string | null) => void,
    keys: Readonly<Record<string, () => void>>,
    request: () => void,
  ) {
    canvas.addEventListener("pointerdown", ({ clientX, clientY }) => this.down.set(clientX, clientY));
    canvas.addEventListener("pointerup", (event) => this.released(event));
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons !== 0 || event.pointerType === "touch") return;
      this.pointer = event;
      request();
    });
    canvas.addEventListener("pointerleave", () => {
      this.pointer = null;
      canvas.classList.remove("pointing");
    });
    canvas.addEventListener("keydown", (event) => {
      if (this.tool?.typed(event) !== true) return;
      event.preventDefault();
      event.stopImmediatePropagation();
    });
    onKeys(canvas, keys);
  }

  /** Let a tool take the clicks, or null for the selection of buildings. */
  use(tool: Tool | null): void {
    this.tool = tool;
    this.canvas.classList.toggle("measuring", tool !== null);
    this.canvas.classList.remove("pointing");
    this.hovered = null;
  }

  /** Look at what is below the pointer, if it has moved. */
  update(): void {
    if (this.pointer === null) return;
    const { clientX, clientY } = this.pointer;
    this.pointer = null;
    if (this.tool !== null) {
      this.tool.hovered(this.targets.placeAt(clientX, clientY));
      return;
    }
    const id = this.targets.buildingAt(clientX, clientY);
    if (id === this.hovered) return;
    this.hovered = id;
    this.canvas.classList.toggle("pointing", id !== null);
  }

  private released({ button, clientX, clientY }: PointerEvent): void {
    if (button !== 0 || this.down.distanceTo(new Vector2(clientX, clientY)) > CLICK_PX) return;
    if (this.tool !== null) this.tool.clicked(this.targets.placeAt(clientX, clientY));
    else this.onPick(this.targets.buildingAt(clientX, clientY));
  }
}
