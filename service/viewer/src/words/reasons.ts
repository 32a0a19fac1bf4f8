/** Why an object is not a building, or has no model of its own kind, in plain words. */

const REASONS: Record<string, string> = {
  too_few_points: "too few points for a plane",
  no_plane: "no roof plane was found in its points",
  no_partition: "the roof planes could not be turned into faces",
  invalid_solid: "the solid is not valid",
  too_complex: "it exceeded the work limit of one building",
  no_footprint: "no outline could be made from its points",
  above_points: "a roof face rises above all its points",
  level_through_slope: "a level roof face runs through a slope",
  height_given: "too few points; a block of the height that its footprint states",
  poor_fit: "too few of its points lie on the model",
  scattered: "its points scatter more than those of a roof",
  not_seen: "too much of the roof has no points",
  uncertain: "it may not be a building",
  too_many_faces: "too few points for so many faces",
  internal_error: "a fault of the program in this one building",
  crashed: "it crashed its process; a bundle for a replay is kept",
  timed_out: "it took too long; a bundle for a replay is kept",
  out_of_memory: "it needed too much memory; a bundle for a replay is kept",
  too_small: "its area is below that of the smallest building",
  too_low: "it is lower than the lowest building",
  below_z_avg: "it lies below the walls around it: a street or a yard",
  no_walls: "too little of its outline is wall: a mound or a bank",
  vegetation: "vegetation: rough, many returns, ground seen beneath",
  too_narrow: "narrower than a building: a wall, a hedge or a wire",
  bridge: "the deck of a bridge",
  vehicle: "narrow, low and free all around: a vehicle or a container",
  strips_disagree: "flight strips that do not fit each other here: it may be a building",
  overridden: "an override says that it is not a building",
};

/** A reason in words. */
export function reasonWords(reason: string): string {
  return REASONS[reason] ?? reason.replaceAll("_", " ");
}
