/** Nodes of points in memory, written as a run writes them. */

export interface WrittenPoint {
  /** Stored integers, or metres: x east, y up, z south. */
  place: [number, number, number];
  code?: number;
  plane?: number;
  residualMm?: number;
}

/** A binary glTF of points; `float` stores places as floats. */
export function glbOf(points: readonly WrittenPoint[], translation: number[], step: number, float = false): ArrayBuffer {
  const columns: [string, number, number, (view: DataView, at: number, point: WrittenPoint) => void][] = [
    [
      "POSITION",
      float ? 5126 : 5123,
      float ? 12 : 8,
      (view, at, { place }) =>
        place.forEach((value, i) => (float ? view.setFloat32(at + 4 * i, value, true) : view.setUint16(at + 2 * i, value, true))),
    ],
    ["_CLASS", 5121, 4, (view, at, { code = 1 }) => view.setUint8(at, code)],
    ["_PLANE", 5123, 4, (view, at, { plane = 65535 }) => view.setUint16(at, plane, true)],
    ["_RESIDUAL", 5122, 4, (view, at, { residualMm = -32768 }) => view.setInt16(at, residualMm, true)],
  ];
  const views: { byteOffset: number; byteLength: number; byteStride: number }[] = [];
  let length = 0;
  for (const [, , stride] of columns) {
    views.push({ byteOffset: length, byteLength: stride * points.length, byteStride: stride });
    length += stride * points.length;
  }
  const gltf = {
    asset: { version: "2.0" },
    nodes: [{ mesh: 0, translation, scale: [step, step, step] }],
    meshes: [{ primitives: [{ mode: 0, attributes: Object.fromEntries(columns.map(([name], i) => [name, i])) }] }],
    accessors: columns.map(([name, componentType], i) => ({
      bufferView: i,
      componentType,
      count: points.length,
      type: name === "POSITION" ? "VEC3" : "SCALAR",
    })),
    bufferViews: views,
    buffers: [{ byteLength: length }],
  };
  const bare = JSON.stringify(gltf);
  const text = new TextEncoder().encode(bare.padEnd(Math.ceil(bare.length / 4) * 4));
  const file = new ArrayBuffer(12 + 8 + text.length + 8 + length);
  const view = new DataView(file);
  [0x46546c67, 2, file.byteLength, text.length, 0x4e4f534a].forEach((value, i) => view.setUint32(4 * i, value, true));
  new Uint8Array(file, 20).set(text);
  const binary = 20 + text.length + 8;
  view.setUint32(binary - 8, length, true);
  view.setUint32(binary - 4, 0x004e4942, true);
  columns.forEach(([, , stride, write], i) => {
    points.forEach((point, n) => write(view, binary + views[i].byteOffset + stride * n, point));
  });
  return file;
}
