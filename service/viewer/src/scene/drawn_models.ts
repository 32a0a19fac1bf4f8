/** The models as meshes: which of them are shown, in which colours, and which one is marked. */

import {
  Box3,
  BufferAttribute,
  BufferGeometry,
  Group,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshLambertMaterial,
  type Ray,
} from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import type { Batch } from "../models/batching";
import { coloursOf, type RoofColours } from "../models/colouring";
import { isFlat, isHatched } from "../words/roof_types";
import { boxOf, pick, type Hit } from "./picking";

const STRIPES_M = 1.6;

interface Drawn {
  batch: Batch;
  mesh: Mesh;
  edges: LineSegments;
}

export class DrawnModels {
  readonly object = new Group();
  /** Of all models, also of those that are hidden. */
  readonly bounds = new Box3();
  private readonly surface = new MeshLambertMaterial({ vertexColors: true, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
  private readonly hatching = hatched(this.surface.clone());
  private readonly line = new LineBasicMaterial({ transparent: true, depthWrite: false });
  private readonly outline = new LineMaterial({ linewidth: 3.5, depthTest: true });
  private readonly glow = new MeshLambertMaterial({ vertexColors: true, emissive: "#ffffff", emissiveIntensity: 0.14, polygonOffset: true, polygonOffsetFactor: 0 });
  private readonly drawn: Drawn[] = [];
  private readonly places = new Map<string, { drawn: Drawn; index: number }>();
  private only: ReadonlySet<string> | null = null;
  private mark: { mesh: Mesh; outline: LineSegments2 } | null = null;
  private marked: string | null = null;
  private colouring: RoofColours = "type";

  /** @param onChange Called when something else is to be drawn. */
  constructor(private readonly onChange: () => void) {}

  /** Number of objects. */
  get count(): number {
    return this.places.size;
  }

  has(id: string): boolean {
    return this.places.has(id);
  }

  add(batches: readonly Batch[]): void {
    for (const batch of batches) {
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(batch.positions, 3));
      geometry.setAttribute("normal", new BufferAttribute(batch.normals, 4, true));
      geometry.setAttribute("color", new BufferAttribute(coloursOf(batch, this.colouring), 4, true));
      const mesh = new Mesh(geometry, isHatched(batch.category) ? this.hatching : this.surface);
      mesh.castShadow = !isFlat(batch.category);
      mesh.receiveShadow = true;
      const lines = new BufferGeometry();
      lines.setAttribute("position", new BufferAttribute(batch.edges, 3));
      const drawn = { batch, mesh, edges: new LineSegments(lines, this.line) };
      this.showIn(drawn);
      this.object.add(mesh, drawn.edges);
      this.drawn.push(drawn);
      batch.listed.forEach(({ id }, index) => {
        this.places.set(id, { drawn, index });
        this.bounds.union(boxOf(batch, index));
      });
    }
    this.onChange();
  }

  /** Put these in place of the models; outlines without a model stay. */
  replace(batches: readonly Batch[]): void {
    const staying = this.drawn.filter(({ batch }) => isFlat(batch.category)).map(({ batch }) => batch);
    for (const { mesh, edges } of this.drawn.splice(0)) this.remove(mesh, edges);
    this.places.clear();
    this.bounds.makeEmpty();
    this.add([...staying, ...batches]);
  }

  /** Height of the lowest and of the highest place. */
  heights(): [number, number] {
    return this.bounds.isEmpty() ? [0, 1] : [this.bounds.min.z, this.bounds.max.z];
  }

  /** The middle of each model at the height of its floor: x, y, z one after another. */
  floors(): number[] {
    return this.all((batch, index) => {
      const [x0, y0, z, x1, y1] = batch.boxes.subarray(6 * index, 6 * index + 6);
      return [(x0 + x1) / 2, (y0 + y1) / 2, z];
    }).flat();
  }

  /** The boxes of the shown models; of all models if none is shown. */
  boxes(): Box3[] {
    const shown = this.all((batch, index) => (batch.shown?.[index] === 0 ? null : boxOf(batch, index))).filter((box) => box !== null);
    return shown.length > 0 ? shown : this.all((batch, index) => boxOf(batch, index));
  }

  /** The batches of the shown models. */
  shown(): Batch[] {
    return this.drawn.filter(({ mesh }) => mesh.visible).map(({ batch }) => batch);
  }

  /** The first of the shown models that a ray meets, at its outer side only if `fromOutside`. */
  first(ray: Ray, fromOutside = false): Hit<Batch> | null {
    return pick(this.shown(), ray, fromOutside);
  }

  /** Show these objects and hide all others; null shows all. */
  showOnly(ids: ReadonlySet<string> | null): void {
    this.only = ids;
    for (const drawn of this.drawn) this.showIn(drawn);
    this.onChange();
  }

  /** Choose what the colours of the roofs show. */
  colourBy(colouring: RoofColours): void {
    this.colouring = colouring;
    for (const { batch, mesh } of this.drawn) {
      coloursIn(mesh).set(coloursOf(batch, colouring));
      mesh.geometry.getAttribute("color").needsUpdate = true;
    }
    this.select(this.marked);
  }

  /** Mark a building, or none; returns the box around it. */
  select(id: string | null): Box3 | null {
    this.marked = id;
    if (this.mark !== null) this.remove(this.mark.mesh, this.mark.outline);
    this.mark = null;
    this.onChange();
    const place = id === null ? undefined : this.places.get(id);
    if (place === undefined) return null;
    const { index, drawn } = place;
    const { batch } = drawn;
    const [from, to] = [batch.starts[index], batch.starts[index + 1]];
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(batch.positions.slice(3 * from, 3 * to), 3));
    geometry.setAttribute("normal", new BufferAttribute(batch.normals.slice(4 * from, 4 * to), 4, true));
    geometry.setAttribute("color", new BufferAttribute(coloursIn(drawn.mesh).slice(4 * from, 4 * to), 4, true));
    const ends = batch.edges.slice(3 * batch.edgeStarts[index], 3 * batch.edgeStarts[index + 1]);
    this.mark = {
      mesh: new Mesh(geometry, this.glow),
      outline: new LineSegments2(new LineSegmentsGeometry().setPositions(ends), this.outline),
    };
    this.object.add(this.mark.mesh, this.mark.outline);
    return boxOf(batch, index);
  }

  /** The colours of the edges and of the mark. */
  paint(edges: string, accent: string): void {
    this.line.color.set(edges);
    this.outline.color.set(accent);
  }

  /** Lines of one pixel would cover small buildings: they fade before that. */
  fade(pixelsPerMetre: number): void {
    this.line.opacity = Math.min(Math.max((pixelsPerMetre - 0.7) / 5, 0), 0.75);
    this.line.visible = this.line.opacity > 0.02;
  }

  dispose(): void {
    for (const { mesh, edges } of this.drawn) this.remove(mesh, edges);
  }

  private all<T>(of: (batch: Batch, index: number) => T): T[] {
    return this.drawn.flatMap(({ batch }) => batch.listed.map((_, index) => of(batch, index)));
  }

  /** Draw the shown buildings of a batch only. */
  private showIn({ batch, mesh, edges }: Drawn): void {
    const { only } = this;
    const shown = only === null ? undefined : Uint8Array.from(batch.listed, ({ id }) => (only.has(id) ? 1 : 0));
    batch.shown = shown;
    mesh.visible = edges.visible = shown?.includes(1) ?? true;
    drawOnly(mesh.geometry, batch.starts, shown);
    drawOnly(edges.geometry, batch.edgeStarts, shown);
  }

  private remove(...objects: (Mesh | LineSegments | LineSegments2)[]): void {
    this.object.remove(...objects);
    for (const { geometry } of objects) geometry.dispose();
  }
}

function coloursIn(mesh: Mesh): Uint8Array {
  return mesh.geometry.getAttribute("color").array as Uint8Array;
}

/** Draw only the shown buildings of a batch: an index names their corners. It is kept, since three frees none. */
function drawOnly(geometry: BufferGeometry, starts: Uint32Array, shown: Uint8Array | undefined): void {
  if (shown === undefined && geometry.index === null) return;
  const index = geometry.index ?? new BufferAttribute(new Uint32Array(starts[starts.length - 1]), 1);
  let n = 0;
  for (let i = 0; i + 1 < starts.length; i++) {
    if (shown?.[i] === 0) continue;
    for (let corner = starts[i]; corner < starts[i + 1]; corner++) index.array[n++] = corner;
  }
  index.needsUpdate = true;
  geometry.setIndex(index);
  geometry.setDrawRange(0, n);
}

/** Draws dark slanted stripes over a material, as a sign in addition to the colour. */
function hatched(material: MeshLambertMaterial): MeshLambertMaterial {
  material.onBeforeCompile = (shader) => {
    shader.vertexShader = shader.vertexShader
      .replace("#include <common>", "#include <common>\nvarying vec3 vHatched;")
      .replace("#include <begin_vertex>", "#include <begin_vertex>\nvHatched = position;");
    shader.fragmentShader = shader.fragmentShader
      .replace("#include <common>", "#include <common>\nvarying vec3 vHatched;")
      .replace(
        "#include <color_fragment>",
        `#include <color_fragment>
        float along = (vHatched.x + vHatched.y + vHatched.z) / ${STRIPES_M.toFixed(2)};
        float blur = clamp(fwidth(along), 0.0, 0.5);
        float stripe = smoothstep(0.5 - blur, 0.5 + blur, abs(fract(along) * 2.0 - 1.0));
        diffuseColor.rgb *= mix(0.55, 1.0, stripe);`,
      );
  };
  return material;
}
