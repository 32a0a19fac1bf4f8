/** The octree of the points: tilesets of 3D Tiles 1.1 with `refine: ADD`, as far as a run writes them. */

import { Box3, Vector3 } from "three";

export type Xyz = readonly [number, number, number];

/** A node of the octree, in metres in the frame of the root tileset: x east, y north, z up. */
export interface Tile {
  /** Address of its points (glb); null if it has none of its own. */
  points: string | null;
  /** Address of the tileset that is its content, to be read; null if there is none or it has been read. */
  tileset: string | null;
  /** The root of that tileset once it has been read: drawn wherever this node is. */
  inner: Tile | null;
  box: Box3;
  /** What is missing if its children are not drawn; 0 for leaves. */
  errorM: number;
  /** Number of its own points; 0 if unknown. */
  count: number;
  /** From coordinates of its content to those of the root. */
  offset: Xyz;
  children: Tile[];
}

/** The facts of the root tileset that the page uses. */
export interface TilesetFacts {
  originM: Xyz;
  nPoints: number;
  /** Points by class. */
  classes: Record<string, number>;
  /** Address of the terrain beneath them, relative to the tileset; null for runs of earlier versions. */
  terrain: string | null;
}

interface RawTile {
  boundingVolume?: { box?: number[] };
  geometricError?: number;
  refine?: string;
  transform?: number[];
  content?: { uri?: string };
  children?: RawTile[];
  extras?: { points?: number };
}

export interface RawTileset {
  asset?: { version?: string };
  root?: RawTile;
  extras?: { origin_m?: number[]; n_points?: number; classes?: Record<string, number>; terrain?: string };
}

/**
 * The root tile of a tileset.
 *
 * @param address Absolute, where the tileset was read.
 * @param offset Of the tileset's frame in the frame of the root tileset.
 * @throws Error if it is not a tileset of the kind that runs write.
 */
export function rootOf(tileset: RawTileset, address: string, offset: Xyz = [0, 0, 0]): Tile {
  const version = tileset.asset?.version ?? "";
  if (!version.startsWith("1.")) throw new Error(`a tileset of version “${version}” is not 3D Tiles 1.x`);
  if (tileset.root === undefined) throw new Error("the tileset has no root");
  return tileOf(tileset.root, address, offset, tileset.root.refine ?? "REPLACE");
}

export function factsOf({ extras, root }: RawTileset): TilesetFacts {
  const [x = 0, y = 0, z = 0] = extras?.origin_m ?? [];
  const nPoints = extras?.n_points ?? root?.extras?.points ?? 0;
  return { originM: [x, y, z], nPoints, classes: extras?.classes ?? {}, terrain: extras?.terrain ?? null };
}

function tileOf(raw: RawTile, address: string, outer: Xyz, refine: string): Tile {
  if (refine !== "ADD") throw new Error(`the refinement “${refine}” is not “ADD”`);
  const offset = moved(outer, raw.transform);
  const box = raw.boundingVolume?.box;
  if (box?.length !== 12) throw new Error("a tile of the tileset has no box");
  const centre = new Vector3(...offset).add(new Vector3().fromArray(box));
  // the box's three half axes, whatever their directions
  const [x, y, z] = [0, 1, 2].map((axis) => Math.abs(box[3 + axis]) + Math.abs(box[6 + axis]) + Math.abs(box[9 + axis]));
  const size = new Vector3(x, y, z).multiplyScalar(2);
  const uri = raw.content?.uri;
  const content = uri === undefined ? null : new URL(uri, address).href;
  const isTileset = content !== null && new URL(content).pathname.endsWith(".json");
  return {
    points: isTileset ? null : content,
    tileset: isTileset ? content : null,
    inner: null,
    box: new Box3().setFromCenterAndSize(centre, size),
    errorM: raw.geometricError ?? 0,
    count: isTileset ? 0 : (raw.extras?.points ?? 0),
    offset,
    children: (raw.children ?? []).map((child) => tileOf(child, address, offset, child.refine ?? refine)),
  };
}

const UNTURNED = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];

function moved(offset: Xyz, transform: number[] | undefined): Xyz {
  if (transform === undefined) return offset;
  if (transform.length !== 16 || UNTURNED.some((value, i) => Math.abs(transform[i] - value) > 1e-9)) {
    throw new Error("a tile of the tileset is turned or scaled");
  }
  return [offset[0] + transform[12], offset[1] + transform[13], offset[2] + transform[14]];
}
