/** Which nodes of the octree are drawn from a place: by screen-space error, within a budget of points. */

import type { Box3, Vector3 } from "three";
import type { Tile } from "./points_tileset";

export interface View {
  eye: Vector3;
  /** Pixels of a metre at a distance of one metre. */
  pixelsPerMetre: number;
  /** Whether any part of a box is in the view. */
  sees: (box: Box3) => boolean;
}

export interface Limits {
  /** Children are drawn where the error of their parent would be larger than this in the view, in pixels. */
  errorPx: number;
  /** Most points at once. */
  points: number;
}

export interface Selection {
  /** Nodes to draw, the most wanted first; their points fit into the budget. */
  tiles: Tile[];
  /** Nodes whose tileset must be read first. */
  unread: Tile[];
}

const NEAREST_M = 0.1;

/**
 * A node is wanted in proportion to the error that its parent alone would show. A parent is never less wanted than its
 * children, since its box holds theirs: what the budget cuts off are the finest nodes.
 */
export function selected(root: Tile, view: View, limits: Limits): Selection {
  const wanted: { tile: Tile; errorPx: number }[] = [];
  const visit = (tile: Tile, parentErrorM: number): void => {
    if (!view.sees(tile.box)) return;
    const scale = view.pixelsPerMetre / Math.max(tile.box.distanceToPoint(view.eye), NEAREST_M);
    wanted.push({ tile, errorPx: parentErrorM * scale });
    if (tile.inner !== null) visit(tile.inner, parentErrorM);
    if (tile.errorM * scale <= limits.errorPx) return;
    for (const child of tile.children) visit(child, tile.errorM);
  };
  visit(root, Infinity);
  wanted.sort((a, b) => (a.errorPx === b.errorPx ? 0 : b.errorPx - a.errorPx));
  const chosen: Selection = { tiles: [], unread: [] };
  let points = 0;
  for (const { tile } of wanted) {
    points += tile.count;
    if (points > limits.points && chosen.tiles.length > 0) break;
    if (tile.tileset !== null) chosen.unread.push(tile);
    if (tile.points !== null) chosen.tiles.push(tile);
  }
  return chosen;
}
