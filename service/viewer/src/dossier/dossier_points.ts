/** The points of one building, from the binary glTF of the service. */

import { originInMetres, type SceneFrame } from "../models/building_mesh";
import { NO_PLANE, NO_RESIDUAL, readNodes, RESIDUAL_SHIFT } from "../points/points_glb";
import type { Points } from "./dossier_geometry";

/**
 * Points in metres around the frame's origin, of all nodes of the file.
 *
 * @throws Error if the file is damaged or of another kind.
 */
export function pointsIn(file: ArrayBuffer, frame: SceneFrame): Points {
  const { nodes, originM } = readNodes(file);
  const origin = originInMetres(frame);
  const [east, north, up] = originM.map((value, axis) => value - origin[axis]);
  const n = nodes.reduce((sum, { count }) => sum + count, 0);
  const points: Points = { xyz: new Float64Array(3 * n), residuals: new Float64Array(n).fill(NaN), planes: new Int32Array(n).fill(-1) };
  let i = 0;
  for (const { count, places, labels, step, translation } of nodes) {
    for (let k = 0; k < count; k++, i++) {
      const [x, y, z] = translation.map((start, axis) => start + step * places[4 * k + axis]);
      points.xyz.set([x + east, -z + north, y + up], 3 * i);
      if (labels[2 * k] !== NO_PLANE) points.planes[i] = labels[2 * k];
      if (labels[2 * k + 1] !== NO_RESIDUAL) points.residuals[i] = (labels[2 * k + 1] - RESIDUAL_SHIFT) / 1000;
    }
  }
  return points;
}
