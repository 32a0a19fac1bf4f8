import type { Building, SurfaceKind } from "./cityjson";
import { ringNormal, triangulate, type Normal } from "./triangulation";

/** One building ready to be drawn, in metres around the scene's origin. */
export interface BuildingMesh {
  /** x, y, z of the triangles' corners. */
  positions: number[];
  /** Normals of the corners, -127 to 127, and a zero each: graphics cards need four bytes. */
  normals: number[];
  /** The surface of each corner: its roof plane, or one of `SURFACE`. */
  surfaces: number[];
  /** x, y, z of both ends of the visible edges. */
  edges: number[];
}

/** Surfaces that are not a numbered roof plane. */
export const SURFACE = { wall: -1, ground: -2, roof: -3 } as const satisfies Record<SurfaceKind, number>;

/** From CRS coordinates to the scene: metres, around an origin that keeps them small. */
export interface SceneFrame {
  origin: readonly [number, number, number];
  /** Metres in a horizontal and in a vertical unit of the CRS. */
  horizontalUnitM: number;
  verticalUnitM: number;
}

/** The origin of the scene in metres. */
export function originInMetres({ origin, horizontalUnitM, verticalUnitM }: SceneFrame): [number, number, number] {
  return [origin[0] * horizontalUnitM, origin[1] * horizontalUnitM, origin[2] * verticalUnitM];
}

/** Faces that meet at a smaller angle look like one surface: no line is drawn between them. */
const SMOOTH = Math.cos((2 * Math.PI) / 180);

/** The triangles and the edges of a building; a building without faces gives none. */
export function buildingMesh(building: Building, frame: SceneFrame): BuildingMesh {
  const vertices = inScene(building.vertices, frame);
  const mesh: BuildingMesh = { positions: [], normals: [], surfaces: [], edges: [] };
  const edges = new Map<number, { normal: Normal; seen: boolean }>();
  const count = vertices.length / 3;
  for (const { kind, rings, plane = -1 } of building.faces) {
    const normal = ringNormal(vertices, rings[0] ?? []);
    const [nx, ny, nz] = normal.map((part) => Math.round(127 * part));
    const surface = kind === "roof" && plane >= 0 ? plane : SURFACE[kind];
    for (const corner of triangulate(vertices, rings, normal)) {
      mesh.positions.push(vertices[3 * corner], vertices[3 * corner + 1], vertices[3 * corner + 2]);
      mesh.normals.push(nx, ny, nz, 0);
      mesh.surfaces.push(surface);
    }
    for (const ring of rings) {
      for (let i = 0; i < ring.length; i++) {
        const from = ring[i];
        const to = ring[i + 1 < ring.length ? i + 1 : 0];
        const key = from < to ? from * count + to : to * count + from;
        const other = edges.get(key);
        if (other === undefined) edges.set(key, { normal, seen: true });
        else other.seen = dot(other.normal, normal) < SMOOTH;
      }
    }
  }
  for (const [key, { seen }] of edges) {
    if (!seen) continue;
    for (const end of [Math.floor(key / count), key % count]) {
      mesh.edges.push(vertices[3 * end], vertices[3 * end + 1], vertices[3 * end + 2]);
    }
  }
  return mesh;
}

/** Coordinates of the CRS as metres around the frame's origin. */
export function inScene(coordinates: Float64Array, frame: SceneFrame): Float64Array {
  const { origin, horizontalUnitM, verticalUnitM } = frame;
  const metres = new Float64Array(coordinates.length);
  for (let i = 0; i < metres.length; i += 3) {
    metres[i] = (coordinates[i] - origin[0]) * horizontalUnitM;
    metres[i + 1] = (coordinates[i + 1] - origin[1]) * horizontalUnitM;
    metres[i + 2] = (coordinates[i + 2] - origin[2]) * verticalUnitM;
  }
  return metres;
}

function dot(a: Normal, b: Normal): number {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
