import { isFlat, type Category } from "../words/roof_types";
import { inScene, type SceneFrame } from "./building_mesh";
import type { Building } from "./cityjson";
import { areaOf, type Point } from "./plan";

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
        const places = ring.map((corner): Point => [vertices[3 * corner], vertices[3 * corner + 1]]);
        if (areaOf(places) < 0 !== place > 0) places.reverse();
        this.xy.push(...places.flat());
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
