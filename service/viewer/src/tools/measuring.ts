/** Distances between two places of the scene, in metres. */

import { measure } from "../words/numbers";

export type Place = readonly [number, number, number];

export interface Measured {
  /** In plan. */
  horizontalM: number;
  /** From the first place up to the second. */
  heightM: number;
  /** In space. */
  slopeM: number;
  /** Angle of the line above the horizontal in degrees, 0 for one place. */
  slopeDeg: number;
}

export function measured(from: Place, to: Place): Measured {
  const horizontalM = Math.hypot(to[0] - from[0], to[1] - from[1]);
  const heightM = to[2] - from[2];
  return {
    horizontalM,
    heightM,
    slopeM: Math.hypot(horizontalM, heightM),
    slopeDeg: (Math.atan2(heightM, horizontalM) * 180) / Math.PI,
  };
}

/** The figures with their names. */
export function inWords({ horizontalM, heightM, slopeM, slopeDeg }: Measured): [string, string][] {
  const sign = heightM > 0.005 ? "+" : "";
  return [
    ["Horizontal distance", measure(horizontalM, 2, "m")],
    ["Height difference", sign + measure(heightM, 2, "m")],
    ["Slope distance", measure(slopeM, 2, "m")],
    ["Inclination", measure(slopeDeg, 1, "°")],
  ];
}
