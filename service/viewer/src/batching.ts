import { buildingMesh, type SceneFrame } from "./building_mesh";
import type { Building, SurfaceKind } from "./cityjson";
import { CATEGORIES, bytesOf, categoryOf, type Category } from "./roof_types";

/** The part of a building's record that the page lists; the whole record is loaded when it is opened. */
export interface Listed {
  id: string;
  category: Category;
  reason: string | null;
  reasonDetail: string | null;
  heightM: number | null;
  areaM2: number | null;
}

/** Buildings of one category, merged into one set of triangles. */
export interface Batch {
  category: Category;
  ids: string[];
  /** Corner at which each building begins, and the number of corners after the last. */
  starts: Uint32Array;
  /** The same for the ends of the edges. */
  edgeStarts: Uint32Array;
  /** x_min, y_min, z_min, x_max, y_max, z_max of each building. */
  boxes: Float32Array;
  positions: Float32Array;
  normals: Int8Array;
  /** Red, green, blue, opaque; in the linear space that three works in. */
  colours: Uint8Array;
  edges: Float32Array;
}

const NEUTRAL: Record<Exclude<SurfaceKind, "roof">, string> = { wall: "#ece7de", ground: "#b9b3a8" };

/** Gathers buildings by category until they are taken as batches. */
export class Batcher {
  private readonly open = new Map<Category, Gathered>();

  constructor(private readonly frame: SceneFrame) {}

  /** Add a building; returns its entry for the list. */
  add(building: Building): Listed {
    const { attributes } = building;
    const category = categoryOf(attributes["status"], attributes["roof_type"]);
    const mesh = buildingMesh(building, this.frame);
    if (mesh.positions.length > 0) {
      const gathered = this.open.get(category) ?? new Gathered(category);
      this.open.set(category, gathered);
      gathered.meshes.push({ id: building.id, mesh });
    }
    return {
      id: building.id,
      category,
      reason: text(attributes["reason"]),
      reasonDetail: text(attributes["reason_detail"]),
      heightM: number(attributes["height_m"]),
      areaM2: number(attributes["footprint_area_m2"]),
    };
  }

  /** The batches of what was added since the last call. */
  take(): Batch[] {
    const batches = [...this.open.values()].map((gathered) => gathered.merged());
    this.open.clear();
    return batches;
  }
}

class Gathered {
  readonly meshes: { id: string; mesh: ReturnType<typeof buildingMesh> }[] = [];

  constructor(private readonly category: Category) {}

  merged(): Batch {
    const n = this.meshes.length;
    const starts = new Uint32Array(n + 1);
    const edgeStarts = new Uint32Array(n + 1);
    this.meshes.forEach(({ mesh }, i) => {
      starts[i + 1] = starts[i] + mesh.positions.length / 3;
      edgeStarts[i + 1] = edgeStarts[i] + mesh.edges.length / 3;
    });
    const corners = starts[n];
    const batch: Batch = {
      category: this.category,
      ids: this.meshes.map(({ id }) => id),
      starts,
      edgeStarts,
      boxes: new Float32Array(6 * n),
      positions: new Float32Array(3 * corners),
      normals: new Int8Array(4 * corners), // four bytes per corner: graphics cards need that alignment
      colours: new Uint8Array(4 * corners).fill(255),
      edges: new Float32Array(3 * edgeStarts[n]),
    };
    const roof = linear(CATEGORIES[this.category].colour);
    this.meshes.forEach(({ mesh }, i) => {
      const { kinds, normals } = mesh;
      batch.positions.set(mesh.positions, 3 * starts[i]);
      batch.edges.set(mesh.edges, 3 * edgeStarts[i]);
      batch.boxes.set(boxOf(mesh.positions), 6 * i);
      for (let corner = 0; corner < kinds.length; corner++) {
        const at = 4 * (starts[i] + corner);
        const kind = kinds[corner];
        const colour = kind === "roof" ? roof : NEUTRAL_LINEAR[kind];
        for (let part = 0; part < 3; part++) {
          batch.normals[at + part] = normals[3 * corner + part];
          batch.colours[at + part] = colour[part];
        }
      }
    });
    return batch;
  }
}

function boxOf(positions: readonly number[]): number[] {
  const box = [Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity];
  for (let i = 0; i < positions.length; i++) {
    const axis = i % 3;
    if (positions[i] < box[axis]) box[axis] = positions[i];
    if (positions[i] > box[axis + 3]) box[axis + 3] = positions[i];
  }
  return box;
}

/** IEC 61966-2-1: sRGB to linear light, both as bytes. */
function linear(colour: string): number[] {
  return bytesOf(colour).map((byte) => {
    const value = byte / 255;
    return Math.round(255 * (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4));
  });
}

const NEUTRAL_LINEAR = { wall: linear(NEUTRAL.wall), ground: linear(NEUTRAL.ground) };

function text(value: unknown): string | null {
  return typeof value === "string" && value !== "" ? value : null;
}

function number(value: unknown): number | null {
  return typeof value === "number" && Number.isFinite(value) ? value : null;
}
