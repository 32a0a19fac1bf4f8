/** The objects that are not buildings, from the table of the results; loaded only when they are wanted. */

import { decompress } from "fzstd";
import { parquetMetadata, parquetReadObjects } from "hyparquet";
import { partOf, request, type Run } from "../api/requests";
import type { Feature } from "../api/types";

/** The columns that are shown; runs of older versions lack some. */
const COLUMNS = ["object_id", "reason", "reason_detail", "geometry", "area_m2", "height_m", "n_points", "detection_confidence"];

/**
 * Read the table of rejected objects of a run.
 *
 * @returns For each object a GeoJSON feature in the coordinates of the tiles; its geometry is the box around it.
 * @throws Problem if it cannot be fetched, Error if it cannot be read, AbortError if cancelled.
 */
export async function rejectedObjects(run: Run, signal: AbortSignal): Promise<Feature[]> {
  const headers = { Accept: "application/vnd.apache.parquet" };
  const response = await request(partOf(run, "results/rejected"), { headers, signal });
  return readRejected(await response.arrayBuffer());
}

/** The features of a Parquet file of rejected objects. */
export async function readRejected(file: ArrayBuffer): Promise<Feature[]> {
  const metadata = parquetMetadata(file);
  const there = new Set(metadata.schema.map(({ name }) => name));
  const rows = await parquetReadObjects({
    file,
    metadata,
    columns: COLUMNS.filter((name) => there.has(name)),
    compressors: { ZSTD: (input, size) => decompress(input, new Uint8Array(size)) },
  });
  return rows.map(({ geometry, ...properties }) => ({
    type: "Feature",
    id: String(properties["object_id"]),
    geometry: geometry as Feature["geometry"],
    properties,
  }));
}
