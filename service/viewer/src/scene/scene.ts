/** The 3D view: what is drawn, seen by a camera. It is independent of the service and of lists. */

import { Color, PCFShadowMap, Scene, Vector2, Vector3, WebGLRenderer, type Ray } from "three";
import type { Batch } from "../models/batching";
import { Camera, TAN_HALF_FOV } from "./camera";
import { DrawnGround } from "./drawn_ground";
import { DrawnModels } from "./drawn_models";
import { groundThrough, type Ground } from "./ground";
import type { Layer } from "./layer";
import { Light } from "./light";
import type { Surfaces } from "./navigation";
import { boxDistance } from "./picking";
import { Pointing } from "./pointing";

const CORNER_PX = 9; // a click nearer to a corner of a model means the corner
const BESIDE = [[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]] as const; // where corners are looked for
const POINT_PX = 4; // the same for points
const BEHIND_M = 0.5; // points may lie this far behind the surface that was met

const LIGHT = { background: "#eef1f4", ground: "#dfe3e0", edges: "#20262c", accent: "#b4441f", sky: 2.1, sun: 2.2 };
const DARK: typeof LIGHT = { background: "#14181d", ground: "#262c33", edges: "#05070a", accent: "#ff9a6b", sky: 1.5, sun: 1.9 };

export class ModelScene {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly light = new Light();
  readonly models = new DrawnModels(() => this.settle());
  private readonly ground = new DrawnGround();
  readonly camera: Camera;
  readonly pointing: Pointing;
  private readonly layers = new Set<Layer>();
  private readonly watch: ResizeObserver;
  private readonly dark = matchMedia("(prefers-color-scheme: dark)");
  private frame = 0;

  /**
   * @param canvas Fills its parent.
   * @param onPick Gets the building that was clicked, null for a click beside all of them; without it the view is a
   *   picture, which may be printed.
   * @throws Error if the browser has no WebGL.
   */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    onPick: ((id: string | null) => void) | null,
  ) {
    const isPicture = onPick === null; // kept after drawing, so that it can be printed
    this.renderer = new WebGLRenderer({ canvas, antialias: true, powerPreference: "high-performance", preserveDrawingBuffer: isPicture });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = PCFShadowMap;
    this.renderer.shadowMap.autoUpdate = false;
    this.camera = new Camera(canvas, this.surfaces(), this.request);
    this.scene.add(this.light.object, this.models.object, this.ground.object);
    this.paint();
    this.dark.addEventListener("change", this.paint);
    const { navigation } = this.camera;
    const keys = {
      ArrowLeft: () => navigation.turn(10, 0),
      ArrowRight: () => navigation.turn(-10, 0),
      ArrowUp: () => navigation.turn(0, 5),
      ArrowDown: () => navigation.turn(0, -5),
      "+": () => navigation.zoom(1.25),
      "=": () => navigation.zoom(1.25),
      "-": () => navigation.zoom(0.8),
      f: () => this.fit(),
      t: () => this.top(),
      ...(onPick === null ? {} : { Escape: () => onPick(null) }),
    };
    this.pointing = new Pointing(canvas, this, onPick ?? (() => undefined), keys, this.request);
    this.watch = new ResizeObserver(() => this.resize());
    this.watch.observe(canvas.parentElement ?? canvas);
    this.resize();
  }

  /** Draw more buildings; until the user moves the view it keeps showing all of them. */
  add(batches: readonly Batch[]): void {
    this.models.add(batches);
    if (batches.length > 0 && !this.camera.navigation.touched) this.fit(false);
  }

  /** All buildings are added: draw the ground below them. */
  finish(): void {
    const { bounds } = this.models;
    if (bounds.isEmpty()) return;
    const size = bounds.getSize(new Vector3());
    const margin = 0.35 * Math.max(size.x, size.y, 30);
    const { min, max } = bounds;
    const box = [min.x - margin, min.y - margin, max.x + margin, max.y + margin];
    this.lay(groundThrough(this.models.floors(), box, 160), true);
  }

  /** Draw this ground from now on. */
  lay(ground: Ground, isGuessed: boolean): void {
    this.ground.lay(ground, isGuessed);
    this.paint();
    this.settle();
    this.camera.stayAbove();
  }

  /** Height of the drawn ground, 0 if there is none. */
  groundAt(x: number, y: number): number {
    return this.ground.heightAt(x, y) ?? 0;
  }

  /** Show or hide the ground; the camera stays above it all the same. */
  showGround(visible: boolean): void {
    this.ground.object.visible = visible;
    this.request();
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

  /** Mark a building, or none; `fly` brings it into view. */
  select(id: string | null, fly: boolean): void {
    const box = this.models.select(id);
    if (fly && box !== null) this.camera.approach(box);
  }

  /** See everything. */
  fit(animated = true): void {
    this.camera.fit(this.models.boxes(), animated);
  }

  /** See everything from straight above, north up. */
  top(): void {
    this.camera.top(this.models.boxes());
  }

  /** Release all resources. */
  dispose(): void {
    cancelAnimationFrame(this.frame);
    this.frame = -1;
    this.watch.disconnect();
    this.dark.removeEventListener("change", this.paint);
    this.camera.navigation.dispose();
    this.models.dispose();
    this.ground.dispose();
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
    if (this.light.shineOn(this.models.bounds)) this.renderer.shadowMap.needsUpdate = true;
    this.request();
  }

  private draw(now: number): void {
    this.frame = 0;
    const { camera, models } = this;
    camera.update(now);
    this.pointing.update();
    camera.setPlanes(boxDistance(models.shown(), camera.view.position));
    models.fade(this.canvas.clientHeight / (2 * camera.distance * TAN_HALF_FOV));
    const heightPx = this.renderer.getDrawingBufferSize(new Vector2()).y;
    for (const layer of this.layers) layer.update?.(camera.view, heightPx);
    const began = performance.now();
    this.renderer.render(this.scene, camera.view);
    const { render } = this.renderer.info;
    Object.assign(this.canvas.dataset, {
      drawn: true,
      models: models.count,
      triangles: render.triangles,
      calls: render.calls,
      frameMs: (performance.now() - began).toFixed(1),
      eyeM: camera.aboveGround().toFixed(2),
    });
    if (camera.isFlying) this.request();
  }

  private readonly paint = (): void => {
    const theme = this.dark.matches ? DARK : LIGHT;
    this.scene.background = new Color(theme.background);
    this.models.paint(theme.edges, theme.accent);
    this.light.set(theme.sky, theme.sun);
    this.ground.paint(theme.ground);
    this.request();
  };

  private resize(): void {
    const place = this.canvas.parentElement ?? this.canvas;
    const [width, height] = [Math.max(place.clientWidth, 1), Math.max(place.clientHeight, 1)];
    this.renderer.setSize(width, height, false);
    this.camera.setAspect(width / height);
    if (!this.camera.navigation.touched) this.fit(false);
    this.request();
  }

  // --- picking

  /** The building that is seen at a place of the page. */
  buildingAt(clientX: number, clientY: number): string | null {
    const hit = this.models.first(this.ray(clientX, clientY));
    return hit?.batch.listed[hit.index]?.id ?? null;
  }

  /** The place that is seen at a place of the page: a point, a model (its corner if that is near) or the ground. */
  placeAt(clientX: number, clientY: number): Vector3 | null {
    const ray = this.ray(clientX, clientY);
    const ground = this.ground.object.visible ? this.ground.distance(ray) : Infinity;
    const surface = Math.min(this.models.first(ray)?.distance ?? Infinity, ground);
    const metresPerPixel = (2 * TAN_HALF_FOV) / Math.max(this.canvas.clientHeight, 1); // at a distance of one metre
    for (const layer of this.layers) {
      const point = layer.pick?.(ray, POINT_PX * metresPerPixel, surface + BEHIND_M);
      if (point != null) return point;
    }
    const place = surface === Infinity ? null : ray.at(surface, new Vector3());
    return this.cornerAt(clientX, clientY) ?? place;
  }

  /** The corner of a model that is seen at a place of the page or beside it; null if there is none. */
  private cornerAt(clientX: number, clientY: number): Vector3 | null {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    let [nearest, best]: [number, Vector3 | null] = [CORNER_PX, null];
    for (const [right, down] of BESIDE) {
      const model = this.models.first(this.ray(clientX + (right * CORNER_PX) / 2, clientY + (down * CORNER_PX) / 2));
      if (model === null) continue;
      for (let n = 0; n < 3; n++) {
        const corner = new Vector3().fromArray(model.batch.positions, 3 * (model.corner + n));
        const seen = corner.clone().project(this.camera.view);
        const away = Math.hypot(left + ((seen.x + 1) / 2) * width - clientX, top + ((1 - seen.y) / 2) * height - clientY);
        if (away <= nearest) [nearest, best] = [away, corner];
      }
    }
    return best;
  }

  /** The ray through a place of the page. */
  private ray(clientX: number, clientY: number): Ray {
    const { navigation } = this.camera;
    return navigation.ray(navigation.inView(clientX, clientY));
  }

  /** What the camera may meet. */
  private surfaces(): Surfaces {
    const { models, ground } = this;
    return {
      bounds: models.bounds,
      meet: (ray) => {
        const [toGround, toModel] = [ground.distance(ray), models.first(ray)?.distance ?? Infinity];
        const distance = Math.min(toGround, toModel);
        return distance === Infinity ? null : { distance, isGround: toGround < toModel };
      },
      wall: (ray) => models.first(ray, true)?.distance ?? Infinity,
      groundAt: (x, y) => ground.heightAt(x, y) ?? -Infinity,
    };
  }
}
