import { Box3, PerspectiveCamera, Vector3 } from "three";
import { expect, test } from "vitest";
import { framing } from "../src/scene/framing";

const BOXES = [
  new Box3(new Vector3(-40, 10, 0), new Vector3(-30, 22, 9)),
  new Box3(new Vector3(55, -60, 4), new Vector3(70, -50, 31)),
  new Box3(new Vector3(0, 80, -3), new Vector3(9, 95, 12)),
];

function corners(): Vector3[] {
  return BOXES.flatMap(({ min, max }) =>
    [min.x, max.x].flatMap((x) => [min.y, max.y].flatMap((y) => [min.z, max.z].map((z) => new Vector3(x, y, z)))),
  );
}

test.each([
  [new Vector3(-0.4, -1, 0.7), 1.6],
  [new Vector3(-0.4, -1, 0.7), 0.5],
  [new Vector3(0, -0.001, 1), 1.2],
  [new Vector3(1, 0.2, 0.1), 2.5],
])("all corners are within the frame and touch two opposite borders", (direction, aspect) => {
  const camera = new PerspectiveCamera(32, aspect, 0.1, 10_000);
  const toCamera = direction.clone().normalize();
  const { target, distance } = framing(BOXES, toCamera, Math.tan((32 * Math.PI) / 360), aspect);
  camera.up.set(0, 0, 1);
  camera.position.copy(target).addScaledVector(toCamera, distance);
  camera.lookAt(target);
  camera.updateMatrixWorld();
  const seen = corners().map((corner) => corner.project(camera));
  const spans = (["x", "y"] as const).map((axis) => {
    const values = seen.map((point) => point[axis]);
    return [Math.min(...values), Math.max(...values)];
  });
  for (const [low, high] of spans) {
    expect(low).toBeGreaterThan(-1 - 1e-6);
    expect(high).toBeLessThan(1 + 1e-6);
  }
  expect(spans.some(([low, high]) => low < -1 + 1e-6 && high > 1 - 1e-6)).toBe(true);
});
