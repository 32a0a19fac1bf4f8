import { getJson, partOf } from "../api/requests";
import { originInMetres } from "../models/building_mesh";
import type { RunObjects } from "../models/run_objects";
import { button, el, isPressed, setPressed } from "../page/elements";
import { announce, asProblem, problemNotice } from "../page/notices";
import { factsOf, type RawTileset } from "../points/points_tileset";
import { groundOf, type TerrainFile } from "../scene/ground";
import type { ModelScene } from "../scene/scene";
import { MeasureTool } from "./measure_tool";
import type { PointsPanel } from "./points_panel";
import "./view_tools.css";

/** The switches over the 3D view, and the cards that belong to them. */
export class ViewTools {
  /** The buttons. */
  readonly element = el("div", { class: "tool-group switches", role: "group", "aria-label": "Show and measure", hidden: true });
  /** Lies over the canvas. */
  readonly cards = el("div", { class: "stage-cards" });
  private readonly points = button("Points", () => void this.togglePoints(), { title: "Show the points over the models", "aria-pressed": "false" });
  private readonly fault = el("div", { class: "stage-fault" });
  private readonly calledOff = new AbortController();
  private scene: ModelScene | null = null;
  private measuring: MeasureTool | null = null;
  private panel: PointsPanel | null = null;

  constructor(private readonly run: RunObjects) {}

  /** All buttons over the view: these and some more. */
  bar(...more: HTMLElement[]): HTMLElement {
    return el("div", { class: "tools" }, this.element, ...more);
  }

  /** Something else is shown in place of the 3D view, or it is back. */
  setAway(away: boolean): void {
    if (away) this.measuring?.end();
    this.element.classList.toggle("away", away);
    this.cards.hidden = away;
  }

  /** Offer what the scene can do. */
  attach(scene: ModelScene, canvas: HTMLCanvasElement): void {
    this.scene = scene;
    this.measuring = new MeasureTool(scene, canvas);
    const toggle = (): void => {
      const shown = !isPressed(ground);
      setPressed(ground, shown);
      scene.showGround(shown);
      announce(shown ? "The ground is shown." : "The ground is hidden.");
    };
    const ground = button("Ground", toggle, { title: "Show the ground", "aria-pressed": "true" });
    this.element.replaceChildren(ground, this.measuring.button);
    this.element.hidden = false;
    this.cards.replaceChildren(this.fault, this.measuring.card);
    canvas.after(this.measuring.cross);
  }

  /** Offer the points of the run, and draw their terrain, if it has any. */
  async offerPoints(): Promise<void> {
    await this.tried(async (signal) => {
      const outputs = await getJson<Record<string, unknown>>(partOf(this.run, "results"), { signal });
      if (!("tileset" in outputs)) return;
      this.element.prepend(this.points);
      await this.tried((again) => this.layTerrain(again));
    });
  }

  /** Draw the terrain of a run with points; those of earlier versions have none. */
  private async layTerrain(signal: AbortSignal): Promise<void> {
    const tileset = await getJson<RawTileset>(partOf(this.run, "points/tileset.json"), { signal });
    const file = factsOf(tileset).terrain;
    const terrain = file === null ? null : await getJson<TerrainFile>(partOf(this.run, `points/${file}`), { signal });
    const ground = terrain === null ? null : groundOf(terrain, originInMetres(this.run.frame));
    if (ground !== null && !signal.aborted) this.scene?.lay(ground, false);
  }

  /** Do something that may fail, and offer to try it again. */
  private async tried(step: (signal: AbortSignal) => Promise<void>): Promise<void> {
    const { signal } = this.calledOff;
    this.fault.replaceChildren();
    try {
      await step(signal);
    } catch (error) {
      if (!signal.aborted) this.fault.replaceChildren(problemNotice(asProblem(error), () => void this.tried(step)));
    }
  }

  /** End all tools. */
  leave(): void {
    this.calledOff.abort();
    this.measuring?.end();
    this.panel?.close();
  }

  private async togglePoints(): Promise<void> {
    const { scene } = this;
    if (scene === null || this.points.getAttribute("aria-busy") === "true") return;
    if (this.panel !== null) {
      this.panel.close();
      this.panel = null;
      setPressed(this.points, false);
      announce("The points are hidden.");
      return;
    }
    this.points.setAttribute("aria-busy", "true");
    await this.tried(async (signal) => {
      // the code of the points is loaded only if they are shown
      const { PointsPanel } = await import("./points_panel");
      const panel = await PointsPanel.open(scene, this.run);
      if (signal.aborted) return panel.close();
      this.panel = panel;
      this.cards.append(panel.element);
      setPressed(this.points, true);
    });
    this.points.removeAttribute("aria-busy");
  }
}
