/** A small 3D view of one building with its points; it turns with the pointer and the arrow keys. */

import {
  BufferAttribute,
  BufferGeometry,
  Color,
  DirectionalLight,
  DoubleSide,
  HemisphereLight,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshLambertMaterial,
  PerspectiveCamera,
  Points as PointCloud,
  PointsMaterial,
  Scene,
  SRGBColorSpace,
  Vector3,
  WebGLRenderer,
} from "three";
import { buildingMesh, type SceneFrame } from "../models/building_mesh";
import type { Building } from "../models/cityjson";
import { pointColour, type Colouring } from "./dossier_drawings";
import type { Points } from "./dossier_geometry";

const FOV_DEG = 30;
const SURFACES = { roof: "#cfd6dd", wall: "#e9e5dd", ground: "#b9b3a8" } as const;

export class DossierScene {
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(FOV_DEG, 1, 0.1, 5000);
  private readonly middle = new Vector3();
  private readonly cloud: PointCloud | null = null;
  private readonly calledOff = new AbortController();
  private readonly watch: ResizeObserver;
  private distance = 10;
  private azimuth = -2.0;
  private elevation = 0.55;
  private frame = 0;

  /** @throws Error if the browser has no WebGL. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    building: Building,
    frame: SceneFrame,
    private readonly points: Points | null,
    colouring: Colouring,
  ) {
    // kept after drawing, so that it can be printed
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.camera.up.set(0, 0, 1);
    const sun = new DirectionalLight("#fff6e8", 1.9);
    sun.position.set(-0.4, -0.8, 1.2);
    this.scene.add(new HemisphereLight("#f4f8ff", "#a89f92", 2), sun);
    this.addModel(building, frame);
    if (points !== null && points.xyz.length > 0) {
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(Float32Array.from(points.xyz), 3));
      this.cloud = new PointCloud(geometry, new PointsMaterial({ size: points.residuals.length > 3000 ? 1.7 : 2.5, sizeAttenuation: false, vertexColors: true }));
      this.scene.add(this.cloud);
    }
    this.colour(colouring);
    this.place(building, frame);
    const { signal } = this.calledOff;
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId), { signal });
    canvas.addEventListener("pointermove", (event) => this.dragged(event), { signal });
    canvas.addEventListener("wheel", (event) => this.wheeled(event), { signal, passive: false });
    canvas.addEventListener("keydown", (event) => this.typed(event), { signal });
    this.watch = new ResizeObserver(() => this.resize());
    this.watch.observe(canvas);
    this.resize();
  }

  colour(colouring: Colouring): void {
    if (this.cloud === null || this.points === null) return;
    const n = this.points.residuals.length;
    const colours = new Float32Array(3 * n);
    const colour = new Color();
    for (let i = 0; i < n; i++) {
      colour.setStyle(pointColour(this.points, i, colouring), SRGBColorSpace).toArray(colours, 3 * i);
    }
    this.cloud.geometry.setAttribute("color", new BufferAttribute(colours, 3));
    this.request();
  }

  dispose(): void {
    this.calledOff.abort();
    this.watch.disconnect();
    cancelAnimationFrame(this.frame);
    this.scene.traverse((object) => {
      if (!(object instanceof Mesh || object instanceof LineSegments || object instanceof PointCloud)) return;
      object.geometry.dispose();
      for (const material of [object.material].flat()) material.dispose();
    });
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  private addModel(building: Building, frame: SceneFrame): void {
    const mesh = buildingMesh(building, frame);
    if (mesh.positions.length === 0) return;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(Float32Array.from(mesh.positions), 3));
    geometry.setAttribute("normal", new BufferAttribute(Int8Array.from(mesh.normals), 3, true));
    const colour = new Color();
    const colours = new Float32Array(mesh.positions.length);
    mesh.kinds.forEach((kind, i) => colour.setStyle(SURFACES[kind], SRGBColorSpace).toArray(colours, 3 * i));
    geometry.setAttribute("color", new BufferAttribute(colours, 3));
    const surface = new MeshLambertMaterial({ vertexColors: true, side: DoubleSide, polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2 });
    const lines = new BufferGeometry();
    lines.setAttribute("position", new BufferAttribute(Float32Array.from(mesh.edges), 3));
    this.scene.add(new Mesh(geometry, surface), new LineSegments(lines, new LineBasicMaterial({ color: "#39424b" })));
  }

  /** Look at all of the model and its points. */
  private place(building: Building, frame: SceneFrame): void {
    const { positions } = buildingMesh(building, frame);
    const low = new Vector3(Infinity, Infinity, Infinity);
    const high = new Vector3(-Infinity, -Infinity, -Infinity);
    const corner = new Vector3();
    for (const coordinates of [positions, this.points?.xyz ?? []]) {
      for (let i = 0; i < coordinates.length; i += 3) {
        corner.set(coordinates[i], coordinates[i + 1], coordinates[i + 2]);
        low.min(corner);
        high.max(corner);
      }
    }
    if (low.x > high.x) return;
    this.middle.addVectors(low, high).multiplyScalar(0.5);
    this.distance = Math.max(2, low.distanceTo(high) / 2.3 / Math.sin((FOV_DEG * Math.PI) / 360));
  }

  private dragged(event: PointerEvent): void {
    if (event.buttons === 0) return;
    this.turn(-event.movementX * 0.008, event.movementY * 0.008);
  }

  private wheeled(event: WheelEvent): void {
    event.preventDefault();
    this.zoom(Math.exp(event.deltaY * 0.001));
  }

  private typed(event: KeyboardEvent): void {
    const turns: Record<string, [number, number]> = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.12], ArrowDown: [0, -0.12] };
    const turn = turns[event.key];
    if (turn !== undefined) this.turn(...turn);
    else if (event.key === "+") this.zoom(0.85);
    else if (event.key === "-") this.zoom(1 / 0.85);
    else return;
    event.preventDefault();
  }

  private turn(azimuth: number, elevation: number): void {
    this.azimuth += azimuth;
    this.elevation = Math.min(1.55, Math.max(-0.2, this.elevation + elevation));
    this.request();
  }

  private zoom(factor: number): void {
    this.distance = Math.min(2000, Math.max(1, this.distance * factor));
    this.request();
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  private request(): void {
    cancelAnimationFrame(this.frame);
    this.frame = requestAnimationFrame(() => this.draw());
  }

  private draw(): void {
    const flat = Math.cos(this.elevation) * this.distance;
    this.camera.position
      .set(Math.cos(this.azimuth) * flat, Math.sin(this.azimuth) * flat, Math.sin(this.elevation) * this.distance)
      .add(this.middle);
    this.camera.far = this.distance * 4 + 500;
    this.camera.near = this.distance / 100;
    this.camera.updateProjectionMatrix();
    this.camera.lookAt(this.middle);
    this.renderer.render(this.scene, this.camera);
    this.canvas.dataset["drawn"] = "true";
  }
}
