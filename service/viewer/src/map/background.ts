/** Tiles in Web Mercator beneath the outlines, if the operator of the service names some; they are bent to the map's plane. */

import { getJson, partOf } from "../api/requests";
import type { Feature } from "../api/types";
import type { Point } from "../models/plan";
import type { RunObjects } from "../models/run_objects";
import { measure } from "../words/numbers";
import { georeference, pairsOf, type Georeference } from "./georeference";
import type { MapView } from "./map_view";
import type { Backdrop, OutlineMap } from "./outline_map";

const TILE_PX = 256;
const SAMPLE = 60; // buildings whose outlines show where the plane lies on Earth; ids are random, so they lie anywhere
const MOST_TILES = 150; // of one picture; more means that the scale is beyond the levels
const KEPT_TILES = 400;
const ANCESTORS = 5; // levels that stand in for tiles that have not arrived
const OVERLAP = 1 / TILE_PX; // of a tile, against seams

/** What the operator set. */
interface TileSource {
  /** https, with {z}, {x} and {y}. */
  template: string;
  credit: string;
  maxZoom: number;
}

/** Lay the operator's tiles beneath the map of a run, if the results lie on Earth. */
export async function layBackground(map: OutlineMap, run: RunObjects, signal: AbortSignal): Promise<void> {
  const given = (name: string): string => document.querySelector<HTMLMetaElement>(`meta[name="${name}"]`)?.content ?? "";
  const { report: { crs }, frame } = run;
  const source: TileSource = { template: given("map-tiles"), credit: given("map-credit"), maxZoom: Number(given("map-max-zoom")) };
  if (source.template === "" || (crs?.to_wgs84 ?? null) === null) return;
  const { origin: [east, north], horizontalUnitM: unit } = frame;
  const inPlane = ([x, y]: Point): Point => [(x - east) * unit, (y - north) * unit];
  const place = await locate(run, inPlane, signal);
  if (place === null) return;
  const within = place.errorM < 0.5 ? "" : ` · placed to within ${measure(place.errorM, 1, "m")}`;
  map.lay(new Background(source, place, map.request), `${source.credit}${within}`);
}

/**
 * Where the plane of the map lies in Web Mercator, from outlines that the service gives in both coordinates.
 *
 * @param inPlane From the coordinates of the tiles to the plane of the map.
 * @returns Null if the results have too few outlines.
 */
async function locate(run: RunObjects, inPlane: (place: Point) => Point, signal: AbortSignal): Promise<Georeference | null> {
  const page = async (crs: string): Promise<Feature[]> => {
    const path = partOf(run, `buildings?limit=${SAMPLE}&crs=${crs}`);
    return (await getJson<{ features: Feature[] }>(path, { signal, headers: { Accept: "application/geo+json" } })).features;
  };
  const [native, degrees] = await Promise.all([page("native"), page("CRS84")]);
  return georeference(pairsOf(native, degrees, inPlane));
}

class Background implements Backdrop {
  private readonly tiles = new Map<string, HTMLImageElement>();

  /** @param onArrival A tile has arrived: draw again. */
  constructor(
    private readonly source: TileSource,
    private readonly place: Georeference,
    private readonly onArrival: () => void,
  ) {}

  draw(context: CanvasRenderingContext2D, view: MapView): void {
    const { toMercator } = this.place;
    const [west, south, east, north] = view.box();
    const corners = ([[west, south], [east, south], [east, north], [west, north]] as Point[]).map(toMercator);
    const [middle, beside] = [toMercator([view.east, view.north]), toMercator([view.east + 1 / view.scale, view.north])];
    const perPixel = Math.hypot(beside[0] - middle[0], beside[1] - middle[1]);
    const sharp = Math.log2(Math.min(devicePixelRatio, 2));
    const level = Math.min(Math.max(Math.round(-Math.log2(perPixel * TILE_PX) + sharp), 0), this.source.maxZoom);
    const side = 2 ** level;
    const span = (axis: 0 | 1): [number, number] => {
      const values = corners.map((corner) => corner[axis] * side);
      return [Math.max(Math.floor(Math.min(...values)), 0), Math.min(Math.floor(Math.max(...values)), side - 1)];
    };
    const [[x0, x1], [y0, y1]] = [span(0), span(1)];
    if ((x1 - x0 + 1) * (y1 - y0 + 1) > MOST_TILES) return;
    for (let y = y0; y <= y1; y++) for (let x = x0; x <= x1; x++) this.drawTile(context, view, level, x, y);
    this.forget();
  }

  private drawTile(context: CanvasRenderingContext2D, view: MapView, level: number, x: number, y: number): void {
    this.request(level, x, y);
    for (let up = 0; up <= Math.min(ANCESTORS, level); up++) {
      const image = this.tiles.get(`${level - up}/${x >> up}/${y >> up}`);
      if (image === undefined || !image.complete || image.naturalWidth === 0) continue;
      const side = 2 ** level;
      const corner = (dx: number, dy: number): Point => {
        const [east, north] = this.place.toPlane([(x + dx) / side, (y + dy) / side]);
        return view.pixel(east, north);
      };
      const [[ax, ay], [bx, by], [cx, cy]] = [corner(0, 0), corner(1 + OVERLAP, 0), corner(0, 1 + OVERLAP)];
      context.save();
      context.transform(bx - ax, by - ay, cx - ax, cy - ay, ax, ay);
      const part = image.naturalWidth / 2 ** up;
      context.drawImage(image, (x % 2 ** up) * part, (y % 2 ** up) * part, part, part, 0, 0, 1, 1);
      context.restore();
      return;
    }
  }

  private request(level: number, x: number, y: number): void {
    const name = `${level}/${x}/${y}`;
    const known = this.tiles.get(name);
    if (known !== undefined) {
      // the latest used is the last to be forgotten
      this.tiles.delete(name);
      this.tiles.set(name, known);
      return;
    }
    const image = new Image();
    image.onload = this.onArrival;
    image.src = this.source.template.replace("{z}", String(level)).replace("{x}", String(x)).replace("{y}", String(y));
    this.tiles.set(name, image);
  }

  private forget(): void {
    for (const name of this.tiles.keys()) {
      if (this.tiles.size <= KEPT_TILES) return;
      this.tiles.delete(name);
    }
  }
}
