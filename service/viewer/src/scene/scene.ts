/** The 3D view: drawing, camera and selection. It is independent of the service and of lists. */

import {
  AmbientLight,
  Box3,
  BufferAttribute,
  BufferGeometry,
  Color,
  DirectionalLight,
  HemisphereLight,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshLambertMaterial,
  type Object3D,
  PCFShadowMap,
  PerspectiveCamera,
  Ray,
  Raycaster,
  Scene,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import type { Batch } from "../models/batching";
import { coloursOf, type Colouring } from "../models/colouring";
import { framing } from "./framing";
import { groundDistance, groundThrough, heightAt, type Ground } from "./ground";
import { groundMesh } from "./ground_mesh";
import { hatched } from "./hatching";
import { Navigation, EYE_M, type Surfaces } from "./navigation";
import { boxDistance, pick, type Hit } from "./picking";
import { isFlat, isHatched } from "../words/roof_types";
import { tintRoofs } from "../models/tinting";

const FOV_DEG = 32;
const START = new Vector3(-0.42, -1, 0.72); // seen from the south-south-west, half from above
const TAN_HALF_FOV = Math.tan((FOV_DEG * Math.PI) / 360);
const CLOSEST_FIT_M = 12;
const RISE_RAD = (5 * Math.PI) / 180; // a step up to where a hill no longer is in the way
const NEAREST_PLANE_M = 0.1;
const IN_FRAME = 0.7; // of a distance, along the view axis: less than the cosine at the corners of a wide view
const CLICK_PX = 5; // farther is a drag
const CORNER_PX = 9; // a click nearer to a corner of a model means the corner
const BESIDE = [[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]] as const; // where corners are looked for
const POINT_PX = 4; // the same for points
const BEHIND_M = 0.5; // points may lie this far behind the surface that was met
const SHADOW_M = 1500; // wider scenes get no shadows: their map would be too coarse
const FLIGHT_MS = 450;

interface Theme {
  background: string;
  ground: string;
  edges: string;
  accent: string;
  sky: number;
  sun: number;
}

const LIGHT: Theme = { background: "#eef1f4", ground: "#dfe3e0", edges: "#20262c", accent: "#b4441f", sky: 2.1, sun: 2.2 };
const DARK: Theme = { background: "#14181d", ground: "#262c33", edges: "#05070a", accent: "#ff9a6b", sky: 1.5, sun: 1.9 };

/** Takes clicks, moves and keys in the view, in place of the selection of buildings. */
export interface Tool {
  /** A click on a place of the scene, null beside everything. */
  clicked(place: Vector3 | null): void;
  /** The pointer moved over a place of the scene. */
  hovered(place: Vector3 | null): void;
  /** True if the key is the tool's. */
  typed(event: KeyboardEvent): boolean;
}

/** Something drawn beside the models. */
export interface Layer {
  readonly object: Object3D;
  /** Called before each frame; the height of the view is in device pixels. */
  update(camera: PerspectiveCamera, heightPx: number): void;
  /** The nearest thing along a ray up to a distance, within `reach` metres per metre of distance beside it. */
  pick(ray: Ray, reach: number, farthest: number): Vector3 | null;
  dispose(): void;
}

interface Drawn {
  batch: Batch;
  mesh: Mesh;
  edges: LineSegments;
}

export class ModelScene {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(FOV_DEG, 1, 1, 10_000);
  private readonly navigation: Navigation;
  private readonly sun = new DirectionalLight("#fff6e8", 2.2);
  private readonly sky = new HemisphereLight("#f4f8ff", "#a89f92", 2.1);
  private readonly surface = new MeshLambertMaterial({ vertexColors: true, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
  private readonly hatching = hatched(this.surface.clone());
  private readonly line = new LineBasicMaterial({ transparent: true, depthWrite: false });
  private readonly outline = new LineMaterial({ linewidth: 3.5, depthTest: true });
  private readonly glow = new MeshLambertMaterial({ vertexColors: true, emissive: "#ffffff", emissiveIntensity: 0.14, polygonOffset: true, polygonOffsetFactor: 0 });
  private readonly drawn: Drawn[] = [];
  private only: ReadonlySet<string> | null = null;
  private readonly places = new Map<string, { drawn: Drawn; index: number }>();
  private readonly bounds = new Box3();
  private readonly watch: ResizeObserver;
  private readonly dark = matchMedia("(prefers-color-scheme: dark)");
  private readonly still = matchMedia("(prefers-reduced-motion: reduce)");
  private groundMesh: Mesh | null = null;
  private groundHeights: Ground | null = null;
  private groundShown = true;
  private selection: { mesh: Mesh; outline: LineSegments2 } | null = null;
  private tool: Tool | null = null;
  private readonly layers = new Set<Layer>();
  private selected: string | null = null;
  private colouring: Colouring = "type";
  private hovered: string | null = null;
  private down = new Vector2();
  private pointer: PointerEvent | null = null;
  private frame = 0;
  private onMove: ((position: Vector3, target: Vector3) => void) | null = null;
  /** The view that `onMove` knows. */
  private known = "";
  private flight: { from: number; start: [Vector3, Vector3]; end: [Vector3, Vector3] } | null = null;

  /**
   * @param canvas Fills its parent.
   * @param onPick Gets the building that was clicked, null for a click beside all of them.
   * @throws Error if the browser has no WebGL.
   */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly onPick: (id: string | null) => void,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = PCFShadowMap;
    this.renderer.shadowMap.autoUpdate = false;
    this.camera.up.set(0, 0, 1);
    this.navigation = new Navigation(
      this.camera,
      canvas,
      this.surfaces(),
      () => this.request(),
      () => (this.flight = null),
      !this.still.matches,
    );
    this.scene.add(this.sky, this.sun, this.sun.target, new AmbientLight("#ffffff", 0.25));
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(4096, 4096);
    this.paint();
    this.dark.addEventListener("change", this.paint);
    canvas.addEventListener("pointerdown", this.pressed);
    canvas.addEventListener("pointerup", this.released);
    canvas.addEventListener("pointermove", this.moved);
    canvas.addEventListener("pointerleave", this.left);
    canvas.addEventListener("keydown", this.typed);
    this.watch = new ResizeObserver(() => this.resize());
    this.watch.observe(canvas.parentElement ?? canvas);
    this.resize();
  }

  /** Draw more buildings; until the user moves the view it keeps showing all of them. */
  add(batches: readonly Batch[]): void {
    this.put(batches);
    if (batches.length > 0 && !this.navigation.touched) this.fit(false);
    this.settle();
  }

  /** Replace the models by these, seen from the same place; outlines without a model stay. */
  replace(batches: readonly Batch[]): void {
    const staying = this.drawn.filter(({ batch }) => isFlat(batch.category)).map(({ batch }) => batch);
    for (const { mesh, edges } of this.drawn.splice(0)) {
      this.remove(mesh);
      this.remove(edges);
    }
    this.places.clear();
    this.bounds.makeEmpty();
    this.put([...staying, ...batches]);
    this.settle();
  }

  private put(batches: readonly Batch[]): void {
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
      const edges = new LineSegments(lines, this.line);
      const drawn = { batch, mesh, edges };
      this.showIn(drawn);
      this.scene.add(mesh, edges);
      this.drawn.push(drawn);
      batch.ids.forEach((id, index) => {
        this.places.set(id, { drawn, index });
        this.bounds.union(boxOf(batch, index));
      });
    }
  }

  /** All buildings are added: draw the ground below them. */
  finish(): void {
    if (this.bounds.isEmpty()) return;
    const floors = this.drawn.flatMap(({ batch }) =>
      batch.ids.flatMap((_, i) => {
        const [x0, y0, z, x1, y1] = batch.boxes.subarray(6 * i, 6 * i + 6);
        return [(x0 + x1) / 2, (y0 + y1) / 2, z];
      }),
    );
    const size = this.bounds.getSize(new Vector3());
    const margin = 0.35 * Math.max(size.x, size.y, 30);
    const { min, max } = this.bounds;
    const box = [min.x - margin, min.y - margin, max.x + margin, max.y + margin];
    this.drawGround(groundThrough(floors, box, 160), true);
  }

  /** Draw the measured terrain in place of a ground that is guessed from the floors. */
  layTerrain(terrain: Ground): void {
    this.drawGround(terrain, false);
    this.request();
  }

  private drawGround(ground: Ground, isGuessed: boolean): void {
    this.groundHeights = ground;
    if (this.groundMesh !== null) this.remove(this.groundMesh);
    this.groundMesh = groundMesh(ground, isGuessed);
    this.groundMesh.receiveShadow = true;
    this.groundMesh.visible = this.groundShown;
    this.scene.add(this.groundMesh);
    this.paint();
    this.settle();
    this.navigation.place(this.camera.position.clone(), this.navigation.target.clone()); // above the ground
  }

  /** Height of the drawn ground, 0 if there is none. */
  groundAt(x: number, y: number): number {
    return this.groundHeights === null ? 0 : heightAt(this.groundHeights, x, y);
  }

  /** Show or hide the ground; the camera stays above it all the same. */
  showGround(visible: boolean): void {
    this.groundShown = visible;
    if (this.groundMesh !== null) this.groundMesh.visible = visible;
    this.request();
  }

  /** Let a tool take the clicks, or null for the selection of buildings. */
  use(tool: Tool | null): void {
    this.tool = tool;
    this.canvas.classList.toggle("measuring", tool !== null);
    this.canvas.classList.remove("pointing");
    this.hovered = null;
  }

  /** Draw a layer from now on. */
  addLayer(layer: Layer): void {
    this.layers.add(layer);
    this.scene.add(layer.object);
    this.request();
  }

  /** Remove a layer and release its resources. */
  removeLayer(layer: Layer): void {
    this.layers.delete(layer);
    this.scene.remove(layer.object);
    layer.dispose();
    this.request();
  }

  /** The place that is seen at a place of the page: a point, a model (its corner if that is near) or the ground. */
  placeAt(clientX: number, clientY: number): Vector3 | null {
    const { ray } = castRay(this.inView(clientX, clientY), this.camera);
    const model = this.firstModel(ray);
    const ground =
      this.groundHeights === null || !this.groundShown
        ? null
        : groundDistance(this.groundHeights, ray.origin.toArray(), ray.direction.toArray());
    const surface = Math.min(model?.distance ?? Infinity, ground ?? Infinity);
    const metresPerPixel = (2 * TAN_HALF_FOV) / Math.max(this.canvas.clientHeight, 1); // at a distance of one metre
    for (const layer of this.layers) {
      const point = layer.pick(ray, POINT_PX * metresPerPixel, surface + BEHIND_M);
      if (point !== null) return point;
    }
    return this.cornerAt(clientX, clientY) ?? (surface === Infinity ? null : ray.at(surface, new Vector3()));
  }

  /** The corner of a model that is seen at a place of the page or beside it; null if there is none. */
  private cornerAt(clientX: number, clientY: number): Vector3 | null {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    let [nearest, best]: [number, Vector3 | null] = [CORNER_PX, null];
    for (const [right, down] of BESIDE) {
      const x = clientX + (right * CORNER_PX) / 2;
      const y = clientY + (down * CORNER_PX) / 2;
      const model = this.firstModel(castRay(this.inView(x, y), this.camera).ray);
      if (model === null) continue;
      for (let n = 0; n < 3; n++) {
        const corner = new Vector3().fromArray(model.batch.positions, 3 * (model.corner + n));
        const seen = corner.clone().project(this.camera);
        const away = Math.hypot(left + ((seen.x + 1) / 2) * width - clientX, top + ((1 - seen.y) / 2) * height - clientY);
        if (away <= nearest) [nearest, best] = [away, corner];
      }
    }
    return best;
  }

  /** Show these objects and hide all others; null shows all. */
  showOnly(ids: ReadonlySet<string> | null): void {
    this.only = ids;
    for (const drawn of this.drawn) this.showIn(drawn);
    this.settle();
  }

  /** Draw the shown buildings of a batch only. */
  private showIn({ batch, mesh, edges }: Drawn): void {
    const { only } = this;
    const shown = only === null ? undefined : Uint8Array.from(batch.ids, (id) => (only.has(id) ? 1 : 0));
    batch.shown = shown;
    mesh.visible = edges.visible = shown?.includes(1) ?? true;
    drawOnly(mesh.geometry, batch.starts, shown);
    drawOnly(edges.geometry, batch.edgeStarts, shown);
  }

  /** Choose what the colours of the roofs show. */
  colourBy(colouring: Colouring): void {
    this.colouring = colouring;
    for (const { batch, mesh } of this.drawn) {
      const colours = mesh.geometry.getAttribute("color");
      colours.array.set(coloursOf(batch, colouring));
      colours.needsUpdate = true;
    }
    if (this.selected !== null) this.select(this.selected, false);
    this.request();
  }

  /** Height of the lowest and of the highest place of the models. */
  heights(): [number, number] {
    return this.bounds.isEmpty() ? [0, 1] : [this.bounds.min.z, this.bounds.max.z];
  }

  /** Whether a building is drawn. */
  has(id: string): boolean {
    return this.places.has(id);
  }

  /** Mark a building, or none; `fly` brings it into view. */
  select(id: string | null, fly: boolean): void {
    this.selected = id;
    if (this.selection !== null) {
      this.remove(this.selection.mesh);
      this.remove(this.selection.outline);
      this.selection = null;
    }
    const place = id === null ? undefined : this.places.get(id);
    if (place !== undefined) {
      const { batch } = place.drawn;
      const [from, to] = [batch.starts[place.index], batch.starts[place.index + 1]];
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(batch.positions.slice(3 * from, 3 * to), 3));
      geometry.setAttribute("normal", new BufferAttribute(batch.normals.slice(4 * from, 4 * to), 4, true));
      geometry.setAttribute("color", new BufferAttribute(coloursIn(place.drawn.mesh).slice(4 * from, 4 * to), 4, true));
      const mesh = new Mesh(geometry, this.glow);
      const ends = batch.edges.slice(3 * batch.edgeStarts[place.index], 3 * batch.edgeStarts[place.index + 1]);
      const outline = new LineSegments2(new LineSegmentsGeometry().setPositions(ends), this.outline);
      this.selection = { mesh, outline };
      this.scene.add(mesh, outline);
      if (fly) this.flyTo([boxOf(batch, place.index)], this.heading(), 3.2);
    }
    this.request();
  }

  /** Colour the roofs of single buildings; null keeps the colour of the roof type. */
  tint(colourOf: (id: string) => string | null): void {
    for (const { batch, mesh } of this.drawn) {
      const colours = mesh.geometry.getAttribute("color");
      tintRoofs(batch, colours.array as Uint8Array, colourOf);
      colours.needsUpdate = true;
    }
    this.request();
  }

  /** Call a function with position and target of the camera whenever it has moved, but not after `look`; `atOnce` also now. */
  watchCamera(onMove: (position: Vector3, target: Vector3) => void, atOnce = false): void {
    this.onMove = onMove;
    this.known = this.viewWords();
    if (atOnce) onMove(this.camera.position, this.navigation.target);
  }

  /** Look as another scene does; above the own ground in any case. */
  look(position: Vector3, target: Vector3): void {
    this.flight = null;
    this.navigation.touched = true;
    this.navigation.place(position, target);
    this.known = this.viewWords();
  }

  /** See everything. */
  fit(animated = true): void {
    const direction = this.navigation.touched ? this.heading() : START.clone();
    if (!this.bounds.isEmpty()) this.flyTo(this.boxes(), direction, 1.0, animated);
  }

  /** See everything from straight above, north up. */
  top(): void {
    this.navigation.touched = true;
    if (!this.bounds.isEmpty()) this.flyTo(this.boxes(), new Vector3(0, -0.001, 1), 1.0);
  }

  /** Release all resources. */
  dispose(): void {
    cancelAnimationFrame(this.frame);
    this.frame = -1;
    this.watch.disconnect();
    this.dark.removeEventListener("change", this.paint);
    this.navigation.dispose();
    for (const { mesh, edges } of this.drawn) {
      mesh.geometry.dispose();
      edges.geometry.dispose();
    }
    this.groundMesh?.geometry.dispose();
    for (const layer of this.layers) layer.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  // --- drawing

  /** Draw once, with the browser's next frame: nothing is drawn while nothing changes. */
  readonly request = (): void => {
    if (this.frame === 0) this.frame = requestAnimationFrame((now) => this.draw(now));
  };

  /** Update the shadows after a change. */
  private settle(): void {
    const size = this.bounds.isEmpty() ? 0 : this.bounds.getSize(new Vector3()).length();
    this.sun.castShadow = size > 0 && size < SHADOW_M;
    if (this.sun.castShadow) {
      const middle = this.bounds.getCenter(new Vector3());
      const radius = size / 2;
      this.sun.target.position.copy(middle);
      this.sun.position.copy(middle).add(new Vector3(-0.75, -0.35, 1.0).normalize().multiplyScalar(2 * radius));
      const { camera } = this.sun.shadow;
      camera.left = camera.bottom = -radius;
      camera.right = camera.top = radius;
      camera.near = 0.5 * radius;
      camera.far = 4 * radius;
      camera.updateProjectionMatrix();
      this.sun.shadow.normalBias = Math.min(0.4, radius / 1000);
      this.sun.shadow.bias = -0.0004;
      this.renderer.shadowMap.needsUpdate = true;
    } else {
      this.sun.position.set(-0.75, -0.35, 1.0);
      this.sun.target.position.set(0, 0, 0);
    }
    this.request();
  }

  private draw(now: number): void {
    this.frame = 0;
    if (this.flight !== null) this.fly(now);
    else this.navigation.update();
    if (this.onMove !== null && this.viewWords() !== this.known) {
      this.known = this.viewWords();
      this.onMove(this.camera.position, this.navigation.target);
    }
    if (this.pointer !== null) this.hover(this.pointer);
    const distance = this.camera.position.distanceTo(this.navigation.target);
    this.setPlanes();
    // lines of one pixel would cover small buildings: they fade before that
    const pixelsPerMetre = this.canvas.clientHeight / (2 * distance * TAN_HALF_FOV);
    this.line.opacity = Math.min(Math.max((pixelsPerMetre - 0.7) / 5, 0), 0.75);
    this.line.visible = this.line.opacity > 0.02;
    const heightPx = this.renderer.getDrawingBufferSize(new Vector2()).y;
    for (const layer of this.layers) layer.update(this.camera, heightPx);
    const began = performance.now();
    this.renderer.render(this.scene, this.camera);
    const { render } = this.renderer.info;
    Object.assign(this.canvas.dataset, {
      models: this.places.size,
      triangles: render.triangles,
      calls: render.calls,
      frameMs: (performance.now() - began).toFixed(1),
      eyeM: this.aboveGround().toFixed(2),
    });
    if (this.flight !== null) this.request();
  }

  /** Draw from just before the nearest surface to behind the farthest. */
  private setPlanes(): void {
    const { position } = this.camera;
    const reach = this.bounds.isEmpty() ? 100 : this.bounds.getSize(new Vector3()).length();
    const nearest = Math.min(boxDistance(this.shown(), position.toArray()), this.aboveGround());
    // on a slope the ground beside the camera is nearer than the ground below it
    this.camera.near = Math.max(NEAREST_PLANE_M, 0.5 * IN_FRAME * Math.min(nearest, 2 * reach));
    this.camera.far = this.bounds.isEmpty() ? 1000 : position.distanceTo(this.bounds.getCenter(new Vector3())) + 1.5 * reach;
    this.camera.updateProjectionMatrix();
  }

  /** Height of the camera above the drawn ground; infinity without one. */
  private aboveGround(): number {
    const { x, y, z } = this.camera.position;
    return this.groundHeights === null ? Infinity : z - heightAt(this.groundHeights, x, y);
  }

  private readonly paint = (): void => {
    const theme = this.dark.matches ? DARK : LIGHT;
    this.scene.background = new Color(theme.background);
    this.line.color.set(theme.edges);
    this.outline.color.set(theme.accent);
    this.sky.intensity = theme.sky;
    this.sun.intensity = theme.sun;
    if (this.groundMesh !== null) (this.groundMesh.material as MeshLambertMaterial).color.set(theme.ground);
    this.request();
  };

  private resize(): void {
    const place = this.canvas.parentElement ?? this.canvas;
    const [width, height] = [Math.max(place.clientWidth, 1), Math.max(place.clientHeight, 1)];
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (!this.navigation.touched) this.fit(false);
    this.request();
  }

  private remove(object: Mesh | LineSegments | LineSegments2): void {
    this.scene.remove(object);
    object.geometry.dispose();
  }

  // --- camera

  /** The boxes of the shown buildings; of all buildings if none is shown. */
  private boxes(): Box3[] {
    const boxes = this.drawn.flatMap(({ batch }) =>
      batch.ids.flatMap((_, index) => (batch.shown?.[index] === 0 ? [] : [boxOf(batch, index)])),
    );
    return boxes.length > 0 ? boxes : this.drawn.flatMap(({ batch }) => batch.ids.map((_, index) => boxOf(batch, index)));
  }

  /** Place and target of the camera, to see whether it has moved by a millimetre. */
  private viewWords(): string {
    return [...this.camera.position.toArray(), ...this.navigation.target.toArray()].map((value) => value.toFixed(3)).join(" ");
  }

  /** From the target to the camera. */
  private heading(): Vector3 {
    return this.camera.position.clone().sub(this.navigation.target);
  }

  /** See boxes from a direction, at `room` times the distance that they need; from farther up where a hill is there. */
  private flyTo(boxes: readonly Box3[], direction: Vector3, room: number, animated = true): void {
    const [east, north] = [direction.x, direction.y];
    const plan = Math.max(Math.hypot(east, north), 1e-3);
    let steep = Math.atan2(direction.z, plan);
    let [target, position] = [new Vector3(), new Vector3()];
    for (;;) {
      direction.set((Math.cos(steep) * east) / plan, (Math.cos(steep) * north) / plan, Math.sin(steep)).normalize();
      const view = framing(boxes, direction, TAN_HALF_FOV, this.camera.aspect);
      target = view.target;
      position = target.clone().addScaledVector(direction, Math.max(1.06 * room * view.distance, CLOSEST_FIT_M));
      const hidden = this.groundHeights !== null && position.z < heightAt(this.groundHeights, position.x, position.y) + EYE_M;
      if (!hidden || steep + RISE_RAD > Math.PI / 2) break;
      steep += RISE_RAD;
    }
    if (!animated || this.still.matches) {
      this.navigation.place(position, target);
    } else {
      const start: [Vector3, Vector3] = [this.navigation.target.clone(), this.camera.position.clone()];
      this.flight = { from: performance.now(), start, end: [target, position] };
    }
    this.request();
  }

  private fly(now: number): void {
    if (this.flight === null) return;
    const { from, start, end } = this.flight;
    const share = Math.min(Math.max((now - from) / FLIGHT_MS, 0), 1);
    const eased = share * share * (3 - 2 * share);
    if (share === 1) this.flight = null;
    this.navigation.place(new Vector3().lerpVectors(start[1], end[1], eased), new Vector3().lerpVectors(start[0], end[0], eased));
  }

  // --- picking

  /** A place of the page, within the view: -1 to 1. */
  private inView(clientX: number, clientY: number): Vector2 {
    const frame = this.canvas.getBoundingClientRect();
    return new Vector2((2 * (clientX - frame.left)) / frame.width - 1, 1 - (2 * (clientY - frame.top)) / frame.height);
  }

  private under(event: PointerEvent): string | null {
    const { ray } = castRay(this.inView(event.clientX, event.clientY), this.camera);
    const hit = this.firstModel(ray);
    return hit?.batch.ids[hit.index] ?? null;
  }

  /** The batches of the shown buildings. */
  private shown(): Batch[] {
    return this.drawn.filter(({ mesh }) => mesh.visible).map(({ batch }) => batch);
  }

  private firstModel(ray: Ray, fromOutside = false): Hit<Batch> | null {
    return pick(this.shown(), ray.origin.toArray(), ray.direction.toArray(), fromOutside);
  }

  /** What the camera may meet. */
  private surfaces(): Surfaces {
    return {
      bounds: this.bounds,
      meet: (ray) => {
        const [origin, direction] = [ray.origin.toArray(), ray.direction.toArray()];
        const ground = this.groundHeights === null ? null : groundDistance(this.groundHeights, origin, direction);
        const model = this.firstModel(ray)?.distance ?? Infinity;
        if (ground !== null && ground < model) return { distance: ground, isGround: true };
        return model < Infinity ? { distance: model, isGround: false } : null;
      },
      wall: (ray) => this.firstModel(ray, true)?.distance ?? Infinity,
      groundAt: (x, y) => (this.groundHeights === null ? -Infinity : heightAt(this.groundHeights, x, y)),
    };
  }

  private hover(event: PointerEvent): void {
    this.pointer = null;
    if (this.tool !== null) {
      this.tool.hovered(this.placeAt(event.clientX, event.clientY));
      return;
    }
    const id = this.under(event);
    if (id === this.hovered) return;
    this.hovered = id;
    this.canvas.classList.toggle("pointing", id !== null);
  }

  private readonly pressed = (event: PointerEvent): void => void this.down.set(event.clientX, event.clientY);

  private readonly released = (event: PointerEvent): void => {
    if (event.button !== 0 || this.down.distanceTo(new Vector2(event.clientX, event.clientY)) > CLICK_PX) return;
    if (this.tool !== null) this.tool.clicked(this.placeAt(event.clientX, event.clientY));
    else this.onPick(this.under(event));
  };

  private readonly moved = (event: PointerEvent): void => {
    if (event.buttons !== 0 || event.pointerType === "touch") return;
    this.pointer = event;
    this.request();
  };

  private readonly left = (): void => {
    this.pointer = null;
    this.canvas.classList.remove("pointing");
  };

  private readonly typed = (event: KeyboardEvent): void => {
    if (this.tool?.typed(event) === true) {
      event.preventDefault();
      return;
    }
    const action = (
      {
        ArrowLeft: () => this.navigation.turn(10, 0),
        ArrowRight: () => this.navigation.turn(-10, 0),
        ArrowUp: () => this.navigation.turn(0, 5),
        ArrowDown: () => this.navigation.turn(0, -5),
        "+": () => this.navigation.zoom(1.25),
        "=": () => this.navigation.zoom(1.25),
        "-": () => this.navigation.zoom(0.8),
        f: () => this.fit(),
        t: () => this.top(),
        Escape: () => this.onPick(null),
      } as Record<string, () => void>
    )[event.key];
    if (action === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    action();
  };
}

const caster = new Raycaster();

function castRay(at: Vector2, camera: PerspectiveCamera): Raycaster {
  camera.updateMatrixWorld();
  caster.setFromCamera(at, camera);
  return caster;
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

function boxOf(batch: Batch, index: number): Box3 {
  const [x0, y0, z0, x1, y1, z1] = batch.boxes.subarray(6 * index, 6 * index + 6);
  return new Box3(new Vector3(x0, y0, z0), new Vector3(x1, y1, z1));
}
