/** The ground as it is drawn: guessed from the floors of the models, or measured. */

import { BufferAttribute, BufferGeometry, Group, Mesh, MeshLambertMaterial, type Ray } from "three";
import { groundDistance, heightAt, type Ground } from "./ground";

export class DrawnGround {
  readonly object = new Group();
  private mesh: Mesh | null = null;
  private heights: Ground | null = null;

  lay(ground: Ground, isGuessed: boolean): void {
    this.dispose();
    this.object.clear();
    this.heights = ground;
    this.mesh = groundMesh(ground, isGuessed);
    this.mesh.receiveShadow = true;
    this.object.add(this.mesh);
  }

  paint(colour: string): void {
    (this.mesh?.material as MeshLambertMaterial | undefined)?.color.set(colour);
  }

  /** Its height; null if there is none. */
  heightAt(x: number, y: number): number | null {
    return this.heights === null ? null : heightAt(this.heights, x, y);
  }

  /** Distance along a ray of unit direction; infinity if it does not meet it. */
  distance(ray: Ray): number {
    return this.heights === null ? Infinity : groundDistance(this.heights, ray);
  }

  dispose(): void {
    this.mesh?.geometry.dispose();
  }
}

/** The ground as a mesh. What is only guessed from floors fades out towards its border. */
function groundMesh(ground: Ground, isGuessed: boolean): Mesh {
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
