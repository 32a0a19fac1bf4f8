import { isFlat, type Category } from "../words/roof_types";
import { inScene, type SceneFrame } from "./building_mesh";
import type { Building } from "./cityjson";

/** The outlines of many objects in plan, packed so that they can be handed from a worker to the page. */
export interface Outlines {
  ids: string[];
  categories: Category[];
  /** Ring at which each object begins, and the number of rings. */
  shapeStarts: Uint32Array;
  /** Point at which each ring begins, and the number of points. */
  ringStarts: Uint32Array;
  /**
   * Easting and northing of the points in metres around the scene's origin. Rings are not closed; outer ones run
   * counter-clockwise, holes clockwise.
   */
  xy: Float32Array;
}

/** Gathers outlines: the ground surfaces of models, or the faces of flat objects. */
export class OutlinesInMaking {
  private readonly ids: string[] = [];
  private readonly categories: Category[] = [];
  private readonly shapeStarts = [0];
  private readonly ringStarts = [0];
  private readonly xy: number[] = [];

  add(building: Building, category: Category, frame: SceneFrame): void {
    const vertices = inScene(building.vertices, frame);
    const wanted = isFlat(category) ? "roof" : "ground";
    for (const { kind, rings } of building.faces) {
      if (kind !== wanted) continue;
      rings.forEach((ring, place) => {
        const from = this.xy.length;
        for (const corner of ring) this.xy.push(vertices[3 * corner], vertices[3 * corner + 1]);
        if (isClockwise(this.xy, from) !== place > 0) turnAround(this.xy, from);
        this.ringStarts.push(this.xy.length / 2);
      });
    }
    this.ids.push(building.id);
    this.categories.push(category);
    this.shapeStarts.push(this.ringStarts.length - 1);
  }

  packed(): Outlines {
    return {
      ids: this.ids,
      categories: this.categories,
      shapeStarts: Uint32Array.from(this.shapeStarts),
      ringStarts: Uint32Array.from(this.ringStarts),
      xy: Float32Array.from(this.xy),
    };
  }
}

function isClockwise(xy: readonly number[], from: number): boolean {
  let area = 0;
  for (let i = from, j = xy.length - 2; i < xy.length; j = i, i += 2) {
    // relative to the first point: far from the origin the products would lose the digits that matter
    const [ax, ay, bx, by] = [xy[j] - xy[from], xy[j + 1] - xy[from + 1], xy[i] - xy[from], xy[i + 1] - xy[from + 1]];
    area += ax * by - bx * ay;
  }
  return area < 0;
}

/** Reverse the order of the points from a place on. */
function turnAround(xy: number[], from: number): void {
  const points: [number, number][] = [];
  for (let i = from; i < xy.length; i += 2) points.push([xy[i], xy[i + 1]]);
  xy.splice(from, xy.length - from, ...points.reverse().flat());
}
