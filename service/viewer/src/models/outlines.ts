import { isFlat, type Category } from "../words/roof_types";
import { inScene, type SceneFrame } from "./building_mesh";
import type { Building } from "./cityjson";
import { areaOf, type Point } from "./plan";

/** The outline of an object in plan. */
export interface Outline {
  id: string;
  category: Category;
  /**
   * Easting and northing of each ring's points, one after another, in metres around the scene's origin. Rings are not
   * closed; outer ones run counter-clockwise, holes clockwise.
   */
  rings: Float32Array[];
}

/** The outline of a building: the ground surfaces of its model, or the faces of a flat object. */
export function outlineOf({ id, vertices: coordinates, faces }: Building, category: Category, frame: SceneFrame): Outline {
  const vertices = inScene(coordinates, frame);
  const wanted = isFlat(category) ? "roof" : "ground";
  const ringOf = (ring: readonly number[], isHole: boolean): Float32Array => {
    const places = ring.map((corner): Point => [vertices[3 * corner], vertices[3 * corner + 1]]);
    if (areaOf(places) < 0 !== isHole) places.reverse();
    return Float32Array.from(places.flat());
  };
  const shown = faces.filter(({ kind }) => kind === wanted);
  return { id, category, rings: shown.flatMap(({ rings }) => rings.map((ring, place) => ringOf(ring, place > 0))) };
}
