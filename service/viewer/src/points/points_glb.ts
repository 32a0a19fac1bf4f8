/** Points as binary glTF 2.0: nodes with one primitive of points each, as a run and the service write them. */

import type { Xyz } from "./points_tileset";

/** Points in a form for the graphics card: 12 bytes each, 20 if their places are floats. */
export interface NodePoints {
  count: number;
  /** x east, y up, z south in steps, and the class, one after another. */
  places: Uint16Array | Float32Array;
  /** Roof plane, and residual in mm plus 32768, one after another. */
  labels: Uint16Array;
  /** Metres in a step. */
  step: number;
  /** Place of the steps' zero, in metres, x east, y up, z south. */
  translation: Xyz;
}

/** Value of a point that no model explains. */
export const NO_PLANE = 65535;
/** The same for the residual, as it is stored in `labels`. */
export const NO_RESIDUAL = 0;
/** Stored in `labels` for a residual of zero. */
export const RESIDUAL_SHIFT = 32768;

const MAGIC = 0x46546c67; // "glTF"
const JSON_CHUNK = 0x4e4f534a;
const POINTS_MODE = 0;

type Component = Uint8ArrayConstructor | Int16ArrayConstructor | Uint16ArrayConstructor | Float32ArrayConstructor;
const COMPONENTS: Record<number, Component> = { 5121: Uint8Array, 5122: Int16Array, 5123: Uint16Array, 5126: Float32Array };

interface GltfNode {
  mesh?: number;
  translation?: Xyz;
  /** The same along all axes. */
  scale?: Xyz;
}

interface Gltf {
  asset?: { extras?: { origin_m?: Xyz } };
  nodes?: GltfNode[];
  meshes?: { primitives?: { mode?: number; attributes?: Record<string, number> }[] }[];
  accessors?: { bufferView?: number; byteOffset?: number; componentType: number; count: number }[];
  bufferViews?: { byteOffset?: number; byteLength: number; byteStride?: number }[];
}

/** A file of points with all its nodes. */
export interface PointsFile {
  nodes: NodePoints[];
  /** Easting, northing and elevation of the nodes' origin in metres; 0 if the file does not say. */
  originM: Xyz;
}

/** @throws Error if the file is damaged or of another kind. */
export function readNodes(file: ArrayBuffer): PointsFile {
  const { gltf, binary } = chunksOf(file);
  const nodes = (gltf.nodes ?? []).filter(({ mesh }) => mesh !== undefined).map((node) => nodeOf(gltf, node, file, binary));
  return { nodes, originM: gltf.asset?.extras?.origin_m ?? [0, 0, 0] };
}

function nodeOf(gltf: Gltf, { mesh, translation, scale }: GltfNode, file: ArrayBuffer, binary: number): NodePoints {
  const primitive = gltf.meshes?.[mesh ?? -1]?.primitives?.[0];
  if (primitive?.mode !== POINTS_MODE) throw new Error("the node has no primitive of points");
  const read = (name: string): Column | null => {
    const at = primitive.attributes?.[name];
    return at === undefined ? null : columnOf(gltf, at, file, binary);
  };
  const position = read("POSITION");
  if (position === null) throw new Error("the points have no POSITION");
  const [classes, planes, residuals] = [read("_CLASS"), read("_PLANE"), read("_RESIDUAL")];
  const { count } = position;
  const places = position.values instanceof Float32Array ? new Float32Array(4 * count) : new Uint16Array(4 * count);
  const labels = new Uint16Array(2 * count);
  for (let i = 0; i < count; i++) {
    for (let axis = 0; axis < 3; axis++) places[4 * i + axis] = position.values[i * position.stride + axis];
    places[4 * i + 3] = classes === null ? 1 : classes.values[i * classes.stride];
    labels[2 * i] = planes === null ? NO_PLANE : planes.values[i * planes.stride];
    labels[2 * i + 1] = residuals === null ? NO_RESIDUAL : residuals.values[i * residuals.stride] + RESIDUAL_SHIFT;
  }
  return { count, places, labels, step: scale?.[0] ?? 1, translation: translation ?? [0, 0, 0] };
}

/** Values of an attribute; the next point's are `stride` values on. */
interface Column {
  values: Uint8Array | Int16Array | Uint16Array | Float32Array;
  stride: number;
  count: number;
}

function columnOf({ accessors, bufferViews }: Gltf, index: number, file: ArrayBuffer, binary: number): Column {
  const accessor = accessors?.[index];
  const view = accessor?.bufferView === undefined ? undefined : bufferViews?.[accessor.bufferView];
  const kind = accessor === undefined ? undefined : COMPONENTS[accessor.componentType];
  if (accessor === undefined || view === undefined || kind === undefined) throw new Error("an attribute of the points is missing");
  const size = kind.BYTES_PER_ELEMENT;
  const begin = binary + (view.byteOffset ?? 0) + (accessor.byteOffset ?? 0);
  const end = binary + (view.byteOffset ?? 0) + view.byteLength;
  if (end > file.byteLength || begin % size !== 0) throw new Error("the points are cut off");
  if (view.byteStride === undefined) throw new Error("the attributes of the points have no stride");
  return { values: new kind(file, begin, Math.floor((end - begin) / size)), stride: view.byteStride / size, count: accessor.count };
}

/** The description of a glb and where its data begin. */
function chunksOf(file: ArrayBuffer): { gltf: Gltf; binary: number } {
  const data = new DataView(file);
  if (file.byteLength < 28 || data.getUint32(0, true) !== MAGIC) throw new Error("the points are not a binary glTF");
  const length = data.getUint32(12, true);
  if (data.getUint32(8, true) > file.byteLength || data.getUint32(16, true) !== JSON_CHUNK) throw new Error("the points are cut off");
  const gltf = JSON.parse(new TextDecoder().decode(new Uint8Array(file, 20, length))) as Gltf;
  return { gltf, binary: 20 + length + 8 };
}
