/** CityJSONSeq 2.0: a line of metadata, then one CityJSONFeature per building. */

import { inOrder, levelShown } from "./levels_of_detail";

export type Xyz = [number, number, number];

interface Transform {
  scale: Xyz;
  translate: Xyz;
}

export type SurfaceKind = "roof" | "wall" | "ground";

/** A face of a solid: rings of indices into the building's vertices, the outer ring first. */
export interface Face {
  kind: SurfaceKind;
  rings: number[][];
  /** Number of the roof plane within its building; missing for walls, ground and level blocks. */
  plane?: number;
}

/** One building in coordinates of its CRS. */
export interface Building {
  id: string;
  /** The record's columns, as far as they are known. */
  attributes: Record<string, unknown>;
  /** Easting, northing, elevation one after another. */
  vertices: Float64Array;
  /** The faces of one level of detail; empty if no model could be made. */
  faces: Face[];
  /** All its levels of detail, coarse to fine. */
  levels: string[];
}

const KINDS: Record<string, SurfaceKind> = { RoofSurface: "roof", GroundSurface: "ground", WallSurface: "wall" };

/**
 * Reads the sequence line by line; a further line of metadata applies to the features that follow it.
 *
 * @throws Error if a line is not JSON, or a feature comes before the first line of metadata.
 */
export class SequenceReader {
  /** x_min, y_min, z_min, x_max, y_max, z_max; null if nothing was modelled. */
  extent: readonly number[] | null = null;
  private transform: Transform | null = null;
  private readonly several = new Set<string>();

  /** @param lod The level of detail to read: for each building the finest level up to this one; null for its finest. */
  constructor(private readonly lod: string | null = null) {}

  read(line: string): Building | null {
    const value = JSON.parse(line) as RawLine;
    if (value.type === "CityJSON") {
      this.transform = value.transform ?? { scale: [1, 1, 1], translate: [0, 0, 0] };
      this.extent = value.metadata?.geographicalExtent ?? null;
      return null;
    }
    if (value.type !== "CityJSONFeature") throw new Error(`a line of type ${String(value.type)} in the CityJSONSeq`);
    if (this.transform === null) throw new Error("the CityJSONSeq does not begin with its metadata");
    const building = featureOf(value, this.transform, this.lod);
    if (building.levels.length > 1) for (const level of building.levels) this.several.add(level);
    return building;
  }

  /**
   * The levels of detail to choose from, coarse to fine: those of buildings that have several. A fallback block is not
   * a requested level.
   */
  get levels(): string[] {
    return inOrder(this.several);
  }
}

interface RawSurface {
  type: string;
  plane_id?: unknown;
}

interface RawGeometry {
  type: string;
  lod?: string;
  boundaries: unknown;
  semantics?: { surfaces: RawSurface[]; values: unknown };
}

interface RawLine {
  type?: string;
  id?: string;
  transform?: Transform;
  metadata?: { geographicalExtent?: number[] };
  CityObjects?: Record<string, { type: string; attributes?: Record<string, unknown>; geometry?: RawGeometry[] }>;
  vertices?: Xyz[];
}

function featureOf(line: RawLine, { scale, translate }: Transform, lod: string | null): Building {
  const id = line.id ?? "";
  const raw = line.vertices ?? [];
  const vertices = new Float64Array(raw.length * 3);
  raw.forEach((xyz, i) => {
    for (let axis = 0; axis < 3; axis++) vertices[3 * i + axis] = xyz[axis] * scale[axis] + translate[axis];
  });
  // one level of the whole building: the others are at the same place
  const geometries = Object.values(line.CityObjects ?? {}).flatMap(({ geometry }) => geometry ?? []);
  const levels = inOrder(geometries.map(levelOf));
  const shown = levelShown(levels, lod);
  const faces = geometries.filter((geometry) => levelOf(geometry) === shown).flatMap(facesOf);
  return { id, attributes: line.CityObjects?.[id]?.attributes ?? {}, vertices, faces, levels };
}

function levelOf({ lod }: RawGeometry): string {
  return lod ?? "0";
}

type Rings = number[][];

/** The faces of a geometry; solids give those of all their shells. */
function facesOf(geometry: RawGeometry): Face[] {
  const surfaces = geometry.semantics?.surfaces ?? [];
  const values = geometry.semantics?.values;
  const shell = (boundaries: Rings[], semantic: unknown): Face[] =>
    boundaries.map((rings, i) => {
      const value: unknown = Array.isArray(semantic) ? semantic[i] : undefined;
      return faceOf(rings, typeof value === "number" ? surfaces[value] : undefined);
    });
  if (geometry.type === "Solid") {
    const shells = geometry.boundaries as Rings[][];
    return shells.flatMap((faces, i) => shell(faces, Array.isArray(values) ? values[i] : undefined));
  }
  return geometry.type.endsWith("Surface") ? shell(geometry.boundaries as Rings[], values) : [];
}

function faceOf(rings: Rings, surface: RawSurface | undefined): Face {
  const face: Face = { kind: KINDS[surface?.type ?? ""] ?? "wall", rings };
  if (typeof surface?.plane_id === "number") face.plane = surface.plane_id;
  return face;
}
