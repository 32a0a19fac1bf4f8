import { ofRun, Problem, request, serviceUrl } from "../api/requests";
import { originInMetres, type SceneFrame } from "../models/building_mesh";
import type { RunObjects } from "../models/run_objects";
import { colourSwatch, el } from "../page/elements";
import { choice } from "../page/form_fields";
import { announce, asProblem, problemNotice } from "../page/notices";
import { Tick } from "../page/tick";
import { legendLines, POINT_COLOURINGS, type PointColouring } from "../points/points_colouring";
import { PointsLayer, type Figures } from "../points/points_layer";
import { factsOf, rootOf, type RawTileset, type TilesetFacts, type Xyz } from "../points/points_tileset";
import type { ModelScene } from "../scene/scene";
import { count, counted } from "../words/numbers";

const BUDGET = 3_000_000; // points in a view
const BUDGET_OF_PHONES = 1_000_000;

/** The points of a job over its models: they are loaded as the view needs them. */
export class PointsPanel {
  readonly element: HTMLElement;
  private readonly choice = choice("point-colouring", POINT_COLOURINGS);
  private readonly legend = el("div", { class: "points-legend", role: "group", "aria-label": "Shown points" });
  private readonly figure = el("span", { class: "points-figure" });
  private readonly fault = el("div");
  private readonly layer: PointsLayer;
  private readonly facts: TilesetFacts;

  /**
   * Read the octree and draw its points.
   *
   * @throws Problem if the service does not give it, Error if it cannot be read.
   */
  static async open(scene: ModelScene, { jobPath, method, frame }: RunObjects): Promise<PointsPanel> {
    const get = async (address: string, signal?: AbortSignal): Promise<ArrayBuffer> => {
      const options = { headers: { Accept: "*/*" }, cache: "default" as const, signal: signal ?? null };
      return (await request(ofRun(address, method), options)).arrayBuffer();
    };
    const address = serviceUrl(`${jobPath}/points/tileset.json`);
    const tileset = JSON.parse(new TextDecoder().decode(await get(address))) as RawTileset;
    return new PointsPanel(scene, tileset, address, frame, get);
  }

  private constructor(
    private readonly scene: ModelScene,
    tileset: RawTileset,
    address: string,
    private readonly frame: SceneFrame,
    get: (address: string, signal: AbortSignal) => Promise<ArrayBuffer>,
  ) {
    this.facts = factsOf(tileset);
    const origin = originInMetres(frame);
    const [east, north, up] = this.facts.originM;
    const place: Xyz = [east - origin[0], north - origin[1], up - origin[2]];
    const budget = matchMedia("(pointer: coarse)").matches ? BUDGET_OF_PHONES : BUDGET;
    this.layer = new PointsLayer(rootOf(tileset, address), place, budget, get, {
      onArrival: () => scene.request(),
      onFault: (fault) => this.report(fault),
      onFrame: (figures) => this.write(figures),
    });
    this.choice.addEventListener("change", () => {
      this.colour();
      announce(`The points are coloured by ${POINT_COLOURINGS[this.colouring].toLowerCase()}.`);
    });
    this.element = el(
      "section",
      { class: "stage-card points", "aria-label": "Points" },
      el("div", { class: "points-head" }, el("label", { for: this.choice.id }, "Points by"), this.choice, this.figure),
      // on a phone the legend would hide a third of the view
      el("details", { open: matchMedia("(width > 860px)").matches }, el("summary", {}, "Legend"), this.legend),
      this.fault,
    );
    this.colour();
    scene.addLayer(this.layer);
    announce(`${counted(this.facts.nPoints, "point")}: those that the view needs are loaded.`);
  }

  /** Remove the points. */
  close(): void {
    this.scene.removeLayer(this.layer);
    this.element.remove();
  }

  private get colouring(): PointColouring {
    return this.choice.value as PointColouring;
  }

  private colour(): void {
    const { material } = this.layer;
    const [low, high] = this.scene.models.heights();
    const base = this.frame.origin[2] * this.frame.verticalUnitM;
    material.colourBy(this.colouring);
    material.uniforms["heights"].value = [low, high];
    const lines = legendLines(this.colouring, this.facts.classes, [low + base, high + base]);
    this.legend.replaceChildren(
      ...lines.map(({ colours, label, numbers, count: n }) => {
        const signs = colours.map((colour) => colourSwatch(colour));
        if (numbers.length === 0) return el("div", { class: "legend-row" }, ...signs, el("span", { class: "legend-label" }, label));
        const show = (on: boolean): void => {
          material.show(numbers, on);
          this.scene.request();
        };
        const tick = new Tick(label, show, signs, { class: "legend-row" });
        tick.set(true, n);
        return tick.row;
      }),
    );
    this.scene.request();
  }

  private write({ points, nodes, kept, missing }: Figures): void {
    this.figure.textContent = `${count(points)} of ${count(this.facts.nPoints)}${missing > 0 ? " …" : ""}`;
    Object.assign(this.element.dataset, { points, nodes, kept, missing });
  }

  private report(fault: unknown): void {
    const again = (): void => {
      this.fault.replaceChildren();
      this.layer.retry();
      this.scene.request();
    };
    this.fault.replaceChildren(problemNotice(new Problem(0, "Some points could not be read", asProblem(fault).message, ""), again));
  }
}
