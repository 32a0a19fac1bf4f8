/** The map in place of the 3D view; its code is loaded when it is shown first. */

import type { OutlineMap } from "../map/outline_map";
import type { Outlines } from "../models/outlines";
import { RunObjects } from "../models/run_objects";
import { measure } from "../words/numbers";
import type { Category } from "../words/roof_types";

export class MapPane {
  private map: OutlineMap | null = null;
  private isWanted = false;
  private readonly outlines: Outlines[] = [];
  private only: ReadonlySet<string> | null = null;
  private selected: string | null = null;

  /**
   * @param stage The map is put before what it holds.
   * @param onPick Gets the object that was clicked, null for a click beside all of them.
   */
  constructor(
    private readonly stage: HTMLElement,
    private readonly onPick: (id: string | null) => void,
    private readonly colourOf: (shape: { id: string; category: Category }) => string,
  ) {}

  add(outlines: Outlines): void {
    this.outlines.push(outlines);
    this.map?.add(outlines);
  }

  /** Show these objects and hide all others; null shows all. */
  showOnly(ids: ReadonlySet<string> | null): void {
    this.only = ids;
    this.map?.showOnly(ids);
  }

  select(id: string | null, fly: boolean): void {
    this.selected = id;
    this.map?.select(id, fly);
  }

  /** The colours have changed. */
  recolour(): void {
    this.map?.colourBy(this.colourOf);
  }

  /** See everything; false if the map is not shown. */
  fit(): boolean {
    this.map?.fit();
    return this.map !== null;
  }

  /** Show the map with the operator's tiles beneath it. */
  async open(run: RunObjects, signal: AbortSignal): Promise<void> {
    this.isWanted = true;
    if (this.map !== null) return;
    const { OutlineMap } = await import("../map/outline_map");
    if (!this.isWanted || this.map !== null) return;
    const map = new OutlineMap(this.onPick);
    this.map = map;
    this.recolour();
    this.stage.prepend(map.element);
    for (const outlines of this.outlines) map.add(outlines);
    map.showOnly(this.only);
    map.select(this.selected, this.selected !== null);
    await this.layBackground(map, run, signal);
  }

  close(): void {
    this.isWanted = false;
    this.map?.dispose();
    this.map = null;
  }

  /** Lay the operator's tiles beneath the map, if there are some and the results lie on Earth. */
  private async layBackground(map: OutlineMap, { jobPath, method, report: { crs }, frame }: RunObjects, signal: AbortSignal): Promise<void> {
    if (document.querySelector('meta[name="map-tiles"]') === null || (crs?.to_wgs84 ?? null) === null) return;
    const { Background, locate, tileSource } = await import("../map/background");
    const source = tileSource();
    if (source === null) return;
    const { origin: [east, north], horizontalUnitM: unit } = frame;
    const inPlane = ([x, y]: [number, number]): [number, number] => [(x - east) * unit, (y - north) * unit];
    const place = await locate(jobPath, method, inPlane, signal);
    if (place === null || this.map !== map) return;
    const within = place.errorM < 0.5 ? "" : ` · placed to within ${measure(place.errorM, 1, "m")}`;
    map.lay(new Background(source, place, map.request), `${source.credit}${within}`);
  }
}
