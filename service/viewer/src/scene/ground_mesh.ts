import { BufferAttribute, BufferGeometry, Mesh, MeshLambertMaterial } from "three";
import type { Ground } from "./ground";

/** The ground as a mesh. What is only guessed from floors fades out towards its border. */
export function groundMesh(ground: Ground, isGuessed: boolean): Mesh {
  const { nx, ny, cellM } = ground;
  const positions = new Float32Array(3 * nx * ny);
  const colours = new Float32Array(4 * nx * ny).fill(1);
  for (let row = 0; row < ny; row++) {
    for (let column = 0; column < nx; column++) {
      const at = row * nx + column;
      // a little below the floors, which would otherwise flicker through
      positions.set([ground.xMin + column * cellM, ground.yMin + row * cellM, ground.heights[at] - 0.06], 3 * at);
      const u = (2 * column) / (nx - 1) - 1;
      const v = (2 * row) / (ny - 1) - 1;
      if (!isGuessed) continue;
      const fade = Math.min(Math.max((1 - Math.hypot(u, v)) / 0.35, 0), 1);
      colours[4 * at + 3] = fade * fade * (3 - 2 * fade);
    }
  }
  const index: number[] = [];
  for (let row = 0; row + 1 < ny; row++) {
    for (let column = 0; column + 1 < nx; column++) {
      const a = row * nx + column;
      index.push(a, a + 1, a + nx, a + 1, a + nx + 1, a + nx);
    }
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions, 3));
  geometry.setAttribute("color", new BufferAttribute(colours, 4));
  geometry.setIndex(index);
  geometry.computeVertexNormals();
  // farther back than models are: outlines lie just above the ground, and would be hidden seen from afar
  const offset = { polygonOffset: true, polygonOffsetFactor: 3, polygonOffsetUnits: 3 };
  const mesh = new Mesh(geometry, new MeshLambertMaterial({ vertexColors: true, transparent: true, ...offset }));
  mesh.renderOrder = -1;
  return mesh;
}
