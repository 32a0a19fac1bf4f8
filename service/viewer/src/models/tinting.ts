import { SURFACE, type Batch } from "./batching";
import { linear } from "./colouring";

/**
 * Colour the roofs of single buildings.
 *
 * @param colours Red, green, blue and a fourth byte per corner, in linear light; changed in place.
 * @param colourOf The colour of a building as `#rrggbb`; null keeps its own.
 */
export function tintRoofs(batch: Batch, colours: Uint8Array, colourOf: (id: string) => string | null): void {
  batch.ids.forEach((id, index) => {
    const colour = colourOf(id);
    if (colour === null) return;
    const bytes = linear(colour);
    for (let corner = batch.starts[index]; corner < batch.starts[index + 1]; corner++) {
      const surface = batch.surfaces[corner];
      if (surface !== SURFACE.wall && surface !== SURFACE.ground) colours.set(bytes, 4 * corner);
    }
  });
}
