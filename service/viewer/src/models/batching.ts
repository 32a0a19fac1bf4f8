import { categoryOf, type Category } from "../words/roof_types";
import { buildingMesh, type BuildingMesh, type SceneFrame } from "./building_mesh";
import type { Building } from "./cityjson";
import { figuresOf, flagsOf, type Figures, type Flag } from "./figures";
import { outlineOf, type Outline } from "./outlines";

/** The part of a record that the page lists, sorts and filters; a building's whole record is loaded when it is opened. */
export interface Listed {
  id: string;
  category: Category;
  reason: string | null;
  reasonDetail: string | null;
  /** The id of the given footprint; null without one. */
  sourceId: string | null;
  figures: Figures;
  flags: Flag[];
}

/** Buildings of one category, merged into one set of triangles. */
export interface Batch {
  category: Category;
  /** The buildings, as they are listed. */
  listed: Listed[];
  /** Corner at which each building begins, and the number of corners after the last. */
  starts: Uint32Array;
  /** The same for the ends of the edges. */
  edgeStarts: Uint32Array;
  /** x_min, y_min, z_min, x_max, y_max, z_max of each building. */
  boxes: Float32Array;
  /** 1 for each building that is shown; missing if all are. */
  shown?: Uint8Array;
  positions: Float32Array;
  normals: Int8Array;
  /** The surface of each corner: its roof plane, or one of `SURFACE`. */
  surfaces: Int16Array;
  edges: Float32Array;
}

/** What is known of buildings once they are read: their models, their entries for the list, their outlines. */
export interface Gathered {
  batches: Batch[];
  listed: Listed[];
  outlines: Outline[];
}

/** Gathers buildings by category until they are taken as batches. */
export class Batcher {
  private readonly open = new Map<Category, Meshed[]>();
  private readonly listed: Listed[] = [];
  private readonly outlines: Outline[] = [];

  constructor(private readonly frame: SceneFrame) {}

  /** Number of buildings since the last call of `take`. */
  get size(): number {
    return this.listed.length;
  }

  add(building: Building): void {
    const { attributes } = building;
    const category = categoryOf(attributes["status"], attributes["roof_type"]);
    const mesh = buildingMesh(building, this.frame);
    const listed: Listed = {
      id: building.id,
      category,
      reason: text(attributes["reason"]),
      reasonDetail: text(attributes["reason_detail"]),
      sourceId: text(attributes["source_id"]),
      figures: figuresOf(attributes),
      flags: flagsOf(attributes),
    };
    this.listed.push(listed);
    if (mesh.positions.length > 0) {
      const gathered = this.open.get(category) ?? [];
      this.open.set(category, gathered);
      gathered.push({ listed, mesh });
      this.outlines.push(outlineOf(building, category, this.frame));
    }
  }

  /** What was added since the last call. */
  take(): Gathered {
    const batches = [...this.open].map(([category, gathered]) => merged(category, gathered));
    this.open.clear();
    return { batches, listed: this.listed.splice(0), outlines: this.outlines.splice(0) };
  }
}

interface Meshed {
  listed: Listed;
  mesh: BuildingMesh;
}

function merged(category: Category, all: readonly Meshed[]): Batch {
  const n = all.length;
  const starts = new Uint32Array(n + 1);
  const edgeStarts = new Uint32Array(n + 1);
  all.forEach(({ mesh }, i) => {
    starts[i + 1] = starts[i] + mesh.positions.length / 3;
    edgeStarts[i + 1] = edgeStarts[i] + mesh.edges.length / 3;
  });
  const corners = starts[n];
  const batch: Batch = {
    category,
    listed: all.map(({ listed }) => listed),
    starts,
    edgeStarts,
    boxes: new Float32Array(6 * n),
    positions: new Float32Array(3 * corners),
    normals: new Int8Array(4 * corners),
    surfaces: new Int16Array(corners),
    edges: new Float32Array(3 * edgeStarts[n]),
  };
  all.forEach(({ mesh }, i) => {
    batch.positions.set(mesh.positions, 3 * starts[i]);
    batch.edges.set(mesh.edges, 3 * edgeStarts[i]);
    batch.boxes.set(boxOf(mesh.positions), 6 * i);
    batch.normals.set(mesh.normals, 4 * starts[i]);
    batch.surfaces.set(mesh.surfaces, starts[i]);
  });
  return batch;
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

function text(value: unknown): string | null {
  return typeof value === "string" && value !== "" ? value : null;
}
