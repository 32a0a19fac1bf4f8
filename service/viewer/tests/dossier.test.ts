import { expect, test } from "vitest";
import type { Decision } from "../src/api/types";
import { pointColour, tickStep } from "../src/dossier/dossier_drawings";
import { cutModel, histogram, modelOf, pointsIn, roofEdges, sectionOf, strip, stripWidth, type Points } from "../src/dossier/dossier_geometry";
import { dossierAddress, isDossier } from "../src/dossier/dossier_link";
import { checkRows, formRows, trust, trustFigures, withinWords } from "../src/dossier/dossier_words";
import { SequenceReader } from "../src/models/cityjson";
import { placeOf } from "../src/page/address";
import { palette } from "../src/points/points_colouring";
import { GABLE, METADATA } from "./gable";

const FRAME = { origin: [565000, 5934000, 90] as const, horizontalUnitM: 1, verticalUnitM: 1 };

const house = (() => {
  const reader = new SequenceReader();
  reader.read(JSON.stringify(METADATA));
  const building = reader.read(JSON.stringify(GABLE));
  if (building === null) throw new Error("no house");
  return modelOf(building, FRAME);
})();

/** Points on a line across the house, every decimetre, each with a residual. */
const across = (residual: (i: number) => number): Points => {
  const n = 61;
  const points: Points = { xyz: new Float64Array(3 * n), residuals: new Float64Array(n), planes: new Int32Array(n) };
  for (let i = 0; i < n; i++) points.xyz.set([5.3, i / 10, 4], 3 * i);
  points.residuals.forEach((_, i) => (points.residuals[i] = residual(i)));
  return points;
};

test("a gable has one ridge, two eaves and two verges of two parts", () => {
  const edges = roofEdges(house);
  expect(edges.map(({ kind }) => kind).sort()).toEqual(["eave", "eave", "eave", "eave", "eave", "eave", "ridge"]);
  const ridge = edges.find(({ kind }) => kind === "ridge");
  expect([ridge?.from[2], ridge?.to[2], ridge?.from[1]]).toEqual([5, 5, 3]);
});

test("a roof turned inside out has a valley", () => {
  const sunk = { ...house, vertices: house.vertices.map((value, i) => (i % 3 === 2 && i >= 24 ? 1 : value)) };
  expect(roofEdges(sunk).filter(({ kind }) => kind === "valley")).toHaveLength(1);
});

test("the section runs across the middle of the ridge, east or north to the right", () => {
  const section = sectionOf(house, roofEdges(house));
  expect(section?.at).toEqual([5, 3]);
  expect(section?.along.map((value) => Math.round(value * 1e6) / 1e6 + 0)).toEqual([0, 1]);
  expect(section?.through).toBe("across the longest ridge");
});

test("without a ridge the section runs down the largest face, along a flat one", () => {
  const pent = { ...house, faces: house.faces.slice(0, 1) };
  expect(sectionOf(pent, roofEdges(pent))?.through).toBe("down the largest face");
  const flat = { ...house, faces: [{ kind: "roof" as const, rings: [[0, 1, 2, 3]] }] };
  const section = sectionOf(flat, roofEdges(flat));
  expect([section?.through, section?.along[0]]).toEqual(["along the largest face", 1]);
  expect(sectionOf({ ...house, faces: [] }, [])).toBeNull();
});

test("the cut model is the gable's profile", () => {
  const section = sectionOf(house, roofEdges(house));
  if (section === null) throw new Error("no section");
  const cuts = cutModel(house, section);
  const lines = cuts.map(({ kind, from, to }) => [kind, ...[...from, ...to].map((value) => Math.round(value * 1000) / 1000 + 0)]);
  expect(lines).toContainEqual(["roof", -3, 3, 0, 5]);
  expect(lines).toContainEqual(["roof", 0, 5, 3, 3]);
  expect(lines).toContainEqual(["wall", -3, 0, -3, 3]);
  expect(lines).toContainEqual(["ground", -3, 0, 3, 0]);
  expect(lines).toHaveLength(5);
});

test("a strip takes the points beside its line, and grows until it can be read", () => {
  const section = { at: [5, 3] as const, along: [0, 1] as const, through: "" };
  const points = across(() => 0);
  expect(strip(points, section, 0.2)).toHaveLength(0);
  expect(strip(points, section, 0.5)).toHaveLength(61);
  expect(strip(points, section, 0.5)[0]).toEqual({ index: 0, t: -3, z: 4 });
  expect(stripWidth(points, section)).toBe(0.5);
  expect(stripWidth(points, { ...section, at: [4.6, 3] })).toBe(1);
  expect(stripWidth(points, { ...section, at: [60, 3] })).toBe(2);
});

test("points have the colours of the 3D view, by residual and by plane", () => {
  const residuals = Float64Array.from([-9, -0.3, -0.15, 0, 0.15, 0.3, 9, NaN]);
  const points: Points = { xyz: new Float64Array(24), residuals, planes: Int32Array.from([0, 1, 2, 3, 4, 5, 6, -1]) };
  for (const colouring of ["residual", "plane"] as const) {
    expect([...residuals].map((_, i) => pointColour(points, i, colouring))).toEqual(palette(colouring));
  }
  expect(pointColour({ ...points, planes: points.planes.map(() => 9) }, 0, "plane")).toBe(palette("plane")[2]);
});

test("the histogram loses no point", () => {
  const found = histogram(Float64Array.from([-5, -0.6, -0.01, 0.01, 0.59, 0.6, NaN]));
  expect([found.below, found.above, found.uncovered, found.total]).toEqual([1, 1, 1, 6]);
  expect(found.counts.reduce((sum, value) => sum + value, 0)).toBe(4);
  expect([found.counts[0], found.counts[11], found.counts[12], found.counts[23]]).toEqual([1, 1, 1, 1]);
});

test("ticks are at round figures", () => {
  expect([tickStep(13, 10), tickStep(42, 10), tickStep(0.9, 5)]).toEqual([2, 5, 0.2]);
});

/** A file of two points on plane 3, 12 mm above the roof, and on none; and of the second again in a node of its own. */
function pointsFile(): ArrayBuffer {
  const attributes = { POSITION: 0, _PLANE: 1, _RESIDUAL: 2 };
  const json = JSON.stringify({
    asset: { version: "2.0", extras: { origin_m: [565010, 5934000, 80] } },
    nodes: [{ name: "root" }, { mesh: 0, translation: [1, 2, -3], scale: [0.001, 0.001, 0.001] }, { mesh: 1, translation: [0, 0, 0] }],
    meshes: [{ primitives: [{ attributes, mode: 0 }] }, { primitives: [{ attributes: { POSITION: 3 }, mode: 0 }] }],
    accessors: [
      { bufferView: 0, componentType: 5123, count: 2, type: "VEC3" },
      { bufferView: 1, componentType: 5123, count: 2, type: "SCALAR" },
      { bufferView: 2, componentType: 5122, count: 2, type: "SCALAR" },
      { bufferView: 0, componentType: 5123, byteOffset: 8, count: 1, type: "VEC3" },
    ],
    bufferViews: [
      { byteOffset: 0, byteLength: 16, byteStride: 8 },
      { byteOffset: 16, byteLength: 8, byteStride: 4 },
      { byteOffset: 24, byteLength: 8, byteStride: 4 },
    ],
  });
  const text = new TextEncoder().encode(json.padEnd(Math.ceil(json.length / 4) * 4));
  const data = new DataView(new ArrayBuffer(28 + text.length + 32));
  [0x46546c67, 2, data.byteLength, text.length, 0x4e4f534a].forEach((word, i) => data.setUint32(4 * i, word, true));
  new Uint8Array(data.buffer).set(text, 20);
  data.setUint32(20 + text.length, 32, true);
  const binary = 28 + text.length;
  [0, 0, 0, 0, 500, 1500, 700, 0].forEach((value, i) => data.setUint16(binary + 2 * i, value, true));
  [3, 65535].forEach((value, i) => data.setUint16(binary + 16 + 4 * i, value, true));
  [12, -32768].forEach((value, i) => data.setInt16(binary + 24 + 4 * i, value, true));
  return data.buffer;
}

test("points come as metres around the frame's origin, with their planes and residuals", () => {
  const points = pointsIn(pointsFile(), FRAME);
  expect([...points.xyz].map((value) => Math.round(value * 1000) / 1000)).toEqual([11, 3, -8, 11.5, 2.3, -6.5, 510, -700, 1490]);
  expect([...points.planes]).toEqual([3, -1, -1]);
  expect([...points.residuals]).toEqual([0.012, NaN, NaN]);
  expect(() => pointsIn(new ArrayBuffer(40), FRAME)).toThrow("not a binary glTF");
});

const DECISIONS: Decision[] = [
  { step: 0, kind: "check", name: "roof_points", outcome: "met", detail: "", value: 412, limit: 10 },
  { step: 1, kind: "form", name: "arrangement", outcome: "invalid", detail: "", n_faces: 9, n_planes: 4, validity_codes: [306] },
  { step: 2, kind: "form", name: "traced", outcome: "chosen", detail: "straight borders", n_faces: 4, n_planes: 4, levelled_share: 0.12 },
  { step: 3, kind: "level", name: "1.2", outcome: "chosen", detail: "", n_faces: 1, n_planes: 1 },
];

test("a dossier says what to rely on and what not, in sentences", () => {
  const said = trust({ status: "ok", valid: true, share_within_0_2m: 0.97, unexplained_m2: 14, footprint_area_m2: 60, is_curved: true }, DECISIONS);
  expect(said.good.join(" ")).toMatch(/valid by the rules.*97\u202f% of the points lie within/);
  expect(said.bad).toHaveLength(3);
  expect(said.bad[0]).toMatch(/^14\.0\u202fm² of the roof have no point near them/);
  expect(said.bad.join(" ")).toMatch(/curved.*12\u202f% of the plan were made level/);
  const dome = trust({ status: "ok", valid: true, is_curved: true, roof_type: "dome" }, []);
  expect(dome.good.join(" ")).toMatch(/one curved surface, a dome/);
  expect(dome.bad.join(" ")).not.toMatch(/curved/);
  expect(trust({ status: "failed", reason: "no_plane" }, []).bad).toEqual(["There is no model: no roof plane was found in its points."]);
  expect(trustFigures({ bic_margin: 12 }).map(({ row }) => row["Figure"])).toEqual(["Lead over the next form"]);
});

test("the figures of fit name the points that they are of: older runs did not leave out facades", () => {
  const figures = { share_within_0_2m: 0.97, rmse_m: 0.04 };
  expect(trustFigures(figures).map(({ row }) => row["Figure"])).toEqual(["Points within 0.2 m of the roof", "RMSE of the points"]);
  const now = { ...figures, share_below_roof: 0.3 };
  expect(trustFigures(now).map(({ row }) => row["Figure"])).toEqual(["Roof returns within 0.2 m of the roof", "RMSE of the roof returns"]);
  expect(trust({ ...now, status: "ok" }, []).good[0]).toBe("97\u202f% of the roof returns lie within 0.2 m of the roof.");
  expect(withinWords(0.68, now)).toBe(
    "68\u202f% of all lie within 0.2 m; without the 30\u202f% on facades and below the roof, 97\u202f%",
  );
  expect(withinWords(0.68, figures)).toBe("68\u202f% of all lie within 0.2 m");
  expect(withinWords(0.97, { ...figures, share_below_roof: 0 })).toBe("97\u202f% of all lie within 0.2 m");
});

test("figures are shown beside their limits, forms with their outcome", () => {
  expect(checkRows(DECISIONS)).toEqual([
    { Figure: "Roof points", Value: "412 points", Limit: "from 10 points", Meaning: "enough for a model" },
  ]);
  const rows = formRows(DECISIONS, { rmse_m: 0.053 });
  expect(rows.map((row) => [row["Form"], row["Outcome"]])).toEqual([
    ["Arrangement of the planes' lines", "not a valid solid"],
    ["Traced faces", "chosen"],
    ["LoD1.2", "made"],
  ]);
  expect([rows[0]["Notes"], rows[0]["RMSE"], rows[1]["RMSE"]]).toEqual(["codes 306", "–", "0.053\u202fm"]);
});

test("a doubtful model says why, with the figure and the threshold, and which side of the limit is right", () => {
  const doubtful = { status: "doubtful", reason: "scattered", reason_detail: "its roof returns scatter by 0.32 m, more than 0.15 m" };
  expect(trust(doubtful, []).bad[0]).toBe(
    "The model is doubtful: its points scatter more than those of a roof: its roof returns scatter by 0.32 m, more than 0.15 m.",
  );
  const checks: Decision[] = [
    { step: 0, kind: "check", name: "scatter_m", outcome: "missed", detail: "", value: 0.32, limit: 0.15 },
    { step: 1, kind: "check", name: "share_on_roof", outcome: "missed", detail: "", value: 0.45, limit: 0.7 },
  ];
  expect(checkRows(checks).map((row) => row["Limit"])).toEqual(["up to 0.15\u202fm", "from 70\u202f%"]);
});

test("a dossier has an address of its own, which keeps the query", () => {
  const building = "#/jobs/j/methods/m/buildings/b";
  for (const query of ["", "?status=failed"]) {
    const open = dossierAddress(`${building}${query}`, true);
    expect(open).toBe(`${building}/dossier${query}`);
    expect(dossierAddress(open, true)).toBe(open);
    expect(dossierAddress(open, false)).toBe(`${building}${query}`);
    expect([isDossier(open), isDossier(`${building}${query}`), placeOf(open)?.building]).toEqual([true, false, "b"]);
  }
  expect(isDossier("#/jobs/dossier")).toBe(false);
});
