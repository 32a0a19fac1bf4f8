import { Box3, PerspectiveCamera, Ray, Vector2, Vector3 } from "three";
import { beforeEach, expect, test } from "vitest";
import { groundDistance, groundThrough, heightAt } from "../src/scene/ground";
import { EYE_M, Navigation, type Surfaces } from "../src/scene/navigation";

/** A valley between two hillsides of 30 degrees, 1 km wide and 280 m deep. */
const floors: number[] = [];
for (let x = -500; x <= 500; x += 10) for (let y = -500; y <= 500; y += 50) floors.push(x, y, 0.58 * Math.abs(x));
const GROUND = groundThrough(floors, [-500, -500, 500, 500], 160);
/** A tower in the valley, 20 m wide and 60 m high. */
const TOWER = new Box3(new Vector3(-10, -10, 0), new Vector3(10, 10, 60));

const surfaces: Surfaces = {
  bounds: new Box3(new Vector3(-400, -400, 0), new Vector3(400, 400, 260)),
  meet(ray) {
    const tower = ray.intersectBox(TOWER, new Vector3())?.distanceTo(ray.origin) ?? Infinity;
    const ground = groundDistance(GROUND, ray);
    const distance = Math.min(ground, tower);
    return Number.isFinite(distance) ? { distance, isGround: ground < tower } : null;
  },
  wall: (ray) => (TOWER.containsPoint(ray.origin) ? Infinity : (ray.intersectBox(TOWER, new Vector3())?.distanceTo(ray.origin) ?? Infinity)),
  groundAt: (x, y) => heightAt(GROUND, x, y),
};

class Canvas extends EventTarget {
  readonly style = {};
  readonly clientWidth = 800;
  readonly clientHeight = 600;
  readonly ownerDocument = new EventTarget();
  getBoundingClientRect(): object {
    return { left: 0, top: 0, width: 800, height: 600 };
  }
  getRootNode(): EventTarget {
    return this.ownerDocument;
  }
  setPointerCapture(): void {}
  releasePointerCapture(): void {}

  send(type: string, x: number, y: number, more: object = {}): void {
    const event = (): Event =>
      Object.assign(new Event(type, { cancelable: true }), { clientX: x, clientY: y, pageX: x, pageY: y, pointerId: 1, button: 0 }, more);
    this.dispatchEvent(event());
    if (type.startsWith("pointer") && type !== "pointerdown") this.ownerDocument.dispatchEvent(event());
  }
}

let canvas: Canvas;
let camera: PerspectiveCamera;
let navigation: Navigation;

beforeEach(() => {
  canvas = new Canvas();
  camera = new PerspectiveCamera(32, 800 / 600, 0.1, 10_000);
  camera.up.set(0, 0, 1);
  navigation = new Navigation(camera, canvas as unknown as HTMLElement, surfaces, () => undefined, () => undefined, false);
  // as the view begins: half from above, at the middle of the box around all buildings, far above the valley
  navigation.place(new Vector3(-500, -1190, 990), new Vector3(0, 0, 130));
});

function aboveGround(): number {
  return camera.position.z - heightAt(GROUND, camera.position.x, camera.position.y);
}

function seen(x: number, y: number): Vector3 {
  camera.updateMatrixWorld();
  const at = new Vector2((2 * x) / 800 - 1, 1 - (2 * y) / 600);
  const ray = new Ray(camera.position.clone(), new Vector3(at.x, at.y, 0.5).unproject(camera).sub(camera.position).normalize());
  return ray.at(surfaces.meet(ray)?.distance ?? NaN, new Vector3());
}

function onScreen(point: Vector3): [number, number] {
  camera.updateMatrixWorld();
  const { x, y } = point.clone().project(camera);
  return [400 * (1 + x), 300 * (1 - y)];
}

test("zooming in ends before the surface in the middle of the view, above the ground", () => {
  const hit = seen(400, 300);
  for (let step = 0; step < 60; step++) {
    const before = camera.position.distanceTo(hit);
    navigation.zoom(1.25);
    expect(aboveGround()).toBeGreaterThan(EYE_M - 1e-6);
    expect(camera.position.distanceTo(hit)).toBeLessThan(before + 1e-6);
  }
  expect(camera.position.distanceTo(hit)).toBeLessThan(31);
});

test.each([
  [400, 300],
  [200, 350],
  [650, 420],
  [405, 260],
])("the wheel brings the surface under the pointer nearer and keeps it there (%i, %i)", (x, y) => {
  const hit = seen(x, y);
  const far = camera.position.distanceTo(hit);
  for (let notch = 0; notch < 40; notch++) canvas.send("wheel", x, y, { deltaY: -100, deltaMode: 0 });
  expect(camera.position.distanceTo(hit)).toBeLessThan(far / 20);
  const [column, row] = onScreen(hit);
  expect(column).toBeCloseTo(x, 3);
  expect(row).toBeCloseTo(y, 3);
  for (let notch = 0; notch < 200; notch++) canvas.send("wheel", x, y, { deltaY: -100, deltaMode: 0 });
  expect(aboveGround()).toBeGreaterThan(EYE_M - 1e-6);
  expect(Number.isNaN(seen(x, y).x)).toBe(false);
});

test("the wheel out ends where the scene is still seen", () => {
  for (let notch = 0; notch < 300; notch++) canvas.send("wheel", 10, 10, { deltaY: 100, deltaMode: 0 });
  const radius = surfaces.bounds.getSize(new Vector3()).length() / 2;
  expect(camera.position.distanceTo(new Vector3(0, 0, 130))).toBeLessThan(7 * radius);
});

test("a drag turns around the surface under the pointer", () => {
  const hit = seen(250, 380);
  const from = camera.position.clone();
  canvas.send("pointerdown", 250, 380, { pointerType: "mouse" });
  canvas.send("pointermove", 330, 380, { pointerType: "mouse" });
  canvas.send("pointerup", 330, 380, { pointerType: "mouse" });
  expect(camera.position.distanceTo(from)).toBeGreaterThan(100);
  expect(camera.position.distanceTo(hit)).toBeCloseTo(from.distanceTo(hit), 4);
  const [column, row] = onScreen(hit);
  expect(column).toBeCloseTo(250, 3);
  expect(row).toBeCloseTo(380, 3);
});

test("no turn goes below a hillside or through a wall", () => {
  navigation.place(new Vector3(40, -30, 25), new Vector3(0, -10, 20));
  canvas.send("pointerdown", 400, 300, { pointerType: "mouse" });
  for (let step = 1; step <= 300; step++) {
    canvas.send("pointermove", 400 + 7 * step, 300 - 5 * Math.sin(step / 20) * step, { pointerType: "mouse" });
    expect(aboveGround()).toBeGreaterThan(EYE_M - 1e-6);
    expect(TOWER.containsPoint(camera.position)).toBe(false);
  }
  for (let step = 0; step < 100; step++) {
    navigation.turn(7, step % 2 === 0 ? -20 : 5);
    expect(aboveGround()).toBeGreaterThan(EYE_M - 1e-6);
    expect(TOWER.containsPoint(camera.position)).toBe(false);
  }
});

test("two fingers that part bring the surface between them nearer", () => {
  const hit = seen(400, 320);
  const before = camera.position.distanceTo(hit);
  const touch = { pointerType: "touch" };
  canvas.send("pointerdown", 380, 320, { ...touch, pointerId: 1 });
  canvas.send("pointerdown", 420, 320, { ...touch, pointerId: 2 });
  canvas.send("pointermove", 360, 320, { ...touch, pointerId: 1 });
  canvas.send("pointermove", 440, 320, { ...touch, pointerId: 2 });
  expect(camera.position.distanceTo(hit)).toBeLessThan(0.6 * before);
});
