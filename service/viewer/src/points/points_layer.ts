/** Points over the models, streamed by level of detail. */

import { Box3, BufferAttribute, BufferGeometry, Frustum, Group, Matrix4, Points, Ray, Vector3, type PerspectiveCamera } from "three";
import type { Layer } from "../scene/layer";
import { readNodes, type NodePoints } from "./points_glb";
import { PointsMaterial } from "./points_material";
import { selected } from "./points_selection";
import { rootOf, type RawTileset, type Tile, type Xyz } from "./points_tileset";

const LOADS = 6; // at once: as many as browsers send to one host
const KEPT = 1.5; // of the budget stays in memory, so that a turn of the view loads nothing again
const ERROR_PX = 8; // the writer's error is four times the spacing of the points: here two pixels

/** glTF has y up and z to the south. */
const UPRIGHT = new Matrix4().set(1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1);

interface Loaded {
  points: NodePoints;
  drawn: Points<BufferGeometry, PointsMaterial>;
  /** Number of the frame that drew it last. */
  used: number;
}

export interface Figures {
  /** Points and nodes in the current view. */
  points: number;
  nodes: number;
  /** Points in memory. */
  kept: number;
  /** Nodes that are wanted and still missing. */
  missing: number;
}

/** The calls of the layer to its owner. */
export interface PointsEvents {
  /** Something has arrived: draw again. */
  onArrival: () => void;
  /** A file could not be read; it is not asked for again until `retry`. */
  onFault: (fault: unknown) => void;
  /** The figures of a frame. */
  onFrame: (figures: Figures) => void;
}

export class PointsLayer implements Layer {
  readonly object = new Group();
  readonly material = new PointsMaterial();
  readonly figures: Figures = { points: 0, nodes: 0, kept: 0, missing: 0 };
  private readonly loaded = new Map<Tile, Loaded>();
  private readonly loading = new Map<Tile, AbortController>();
  private readonly faulty = new Set<Tile>();
  private readonly frustum = new Frustum();
  private frame = 0;

  /**
   * @param root Of the octree.
   * @param place Of the octree's origin in the scene.
   * @param budget Most points in a view.
   * @param fetched Reads a file of the tileset.
   */
  constructor(
    private readonly root: Tile,
    place: Xyz,
    private readonly budget: number,
    private readonly fetched: (address: string, signal: AbortSignal) => Promise<ArrayBuffer>,
    private readonly events: PointsEvents,
  ) {
    this.object.position.set(...place);
    this.object.updateMatrixWorld();
  }

  update(camera: PerspectiveCamera, heightPx: number): void {
    this.frame += 1;
    const pixelsPerMetre = (heightPx / 2) * camera.projectionMatrix.elements[5];
    camera.updateMatrixWorld();
    this.frustum.setFromProjectionMatrix(
      new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse).multiply(this.object.matrixWorld),
    );
    const eye = this.object.worldToLocal(camera.position.clone());
    const sees = (box: Box3): boolean => this.frustum.intersectsBox(box);
    const ratio = devicePixelRatio;
    const wanted = selected(this.root, { eye, pixelsPerMetre: pixelsPerMetre / ratio, sees }, { errorPx: ERROR_PX, points: this.budget });
    this.material.uniforms["pixelsPerMetre"].value = pixelsPerMetre;
    this.material.uniforms["pixelRatio"].value = ratio;
    this.draw(wanted.tiles);
    this.figures.missing += wanted.unread.filter((tile) => !this.faulty.has(tile)).length;
    this.load([...wanted.unread, ...wanted.tiles]);
    this.evict();
    this.events.onFrame(this.figures);
  }

  /** Points of hidden classes are not met. */
  pick(ray: Ray, reach: number, farthest: number): Vector3 | null {
    let [nearest, best]: [number, Vector3 | null] = [farthest, null];
    const [inverse, box, point, seen] = [new Matrix4(), new Box3(), new Vector3(), new Vector3()];
    for (const [tile, { points, drawn }] of this.loaded) {
      const { places, labels } = points;
      if (!drawn.visible) continue;
      box.copy(tile.box).translate(this.object.position).expandByScalar(Math.min(reach * farthest, 1));
      if (!ray.intersectsBox(box)) continue;
      // in steps of the node, which are alike in all directions
      const local = ray.clone().applyMatrix4(inverse.copy(drawn.matrixWorld).invert());
      const { origin: o, direction: d } = local;
      for (let i = 0; i < points.count; i++) {
        const [x, y, z] = [places[4 * i] - o.x, places[4 * i + 1] - o.y, places[4 * i + 2] - o.z];
        const along = x * d.x + y * d.y + z * d.z;
        if (along <= 0 || along * points.step >= nearest) continue;
        const beside = x * x + y * y + z * z - along * along;
        if (beside > (reach * along) ** 2) continue;
        if (this.material.hides(places[4 * i + 3], labels[2 * i], labels[2 * i + 1])) continue;
        nearest = along * points.step;
        best = seen.copy(point.fromArray(places, 4 * i)).applyMatrix4(drawn.matrixWorld);
      }
    }
    return best;
  }

  /** Ask again for what could not be read. */
  retry(): void {
    this.faulty.clear();
  }

  dispose(): void {
    for (const abort of this.loading.values()) abort.abort();
    for (const tile of [...this.loaded.keys()]) this.drop(tile);
    this.material.dispose();
  }

  private draw(tiles: readonly Tile[]): void {
    for (const { drawn } of this.loaded.values()) drawn.visible = false;
    this.figures.points = this.figures.nodes = this.figures.missing = 0;
    for (const tile of tiles) {
      const one = this.loaded.get(tile);
      if (one === undefined) {
        this.figures.missing += this.faulty.has(tile) ? 0 : 1;
        continue;
      }
      one.drawn.visible = true;
      one.used = this.frame;
      this.figures.points += one.points.count;
      this.figures.nodes += 1;
    }
  }

  /** Load the most wanted of what is missing; what is no longer wanted is not waited for. */
  private load(wanted: readonly Tile[]): void {
    const still = new Set(wanted);
    for (const [tile, abort] of this.loading) if (!still.has(tile)) abort.abort();
    for (const tile of wanted) {
      if (this.loading.size >= LOADS) return;
      if (this.loaded.has(tile) || this.loading.has(tile) || this.faulty.has(tile)) continue;
      const abort = new AbortController();
      this.loading.set(tile, abort);
      this.take(tile, abort.signal).then(
        () => this.loading.delete(tile),
        (error: unknown) => {
          this.loading.delete(tile);
          if (abort.signal.aborted) return;
          this.faulty.add(tile);
          this.events.onFault(error);
        },
      ).finally(() => this.events.onArrival());
    }
  }

  private async take(tile: Tile, signal: AbortSignal): Promise<void> {
    if (tile.tileset !== null) {
      const file = await this.fetched(tile.tileset, signal);
      const inner = JSON.parse(new TextDecoder().decode(file)) as RawTileset;
      tile.inner = rootOf(inner, tile.tileset, tile.offset);
      tile.tileset = null;
      return;
    }
    const [points] = readNodes(await this.fetched(tile.points as string, signal)).nodes;
    if (points === undefined) throw new Error("the file has no node of points");
    if (signal.aborted) return;
    this.loaded.set(tile, { points, drawn: this.drawnOf(tile, points), used: this.frame });
    this.figures.kept += points.count;
  }

  private drawnOf(tile: Tile, points: NodePoints): Loaded["drawn"] {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(points.places, 4));
    geometry.setAttribute("labels", new BufferAttribute(points.labels, 2));
    const drawn = new Points(geometry, this.material);
    drawn.frustumCulled = false; // the selection has done that
    drawn.matrixAutoUpdate = false;
    drawn.matrix
      .makeTranslation(...tile.offset)
      .multiply(UPRIGHT)
      .multiply(new Matrix4().makeTranslation(...points.translation))
      .multiply(new Matrix4().makeScale(points.step, points.step, points.step));
    drawn.visible = false;
    this.object.add(drawn);
    drawn.updateMatrixWorld(true);
    return drawn;
  }

  /** Release the nodes that were not drawn for longest. */
  private evict(): void {
    const most = KEPT * this.budget;
    if (this.figures.kept <= most) return;
    const unused = [...this.loaded].filter(([, { used }]) => used < this.frame).sort(([, a], [, b]) => a.used - b.used);
    for (const [tile] of unused) {
      if (this.figures.kept <= most) return;
      this.drop(tile);
    }
  }

  private drop(tile: Tile): void {
    const one = this.loaded.get(tile);
    if (one === undefined) return;
    this.loaded.delete(tile);
    this.figures.kept -= one.points.count;
    this.object.remove(one.drawn);
    one.drawn.geometry.dispose();
  }
}
