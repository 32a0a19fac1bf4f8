/** The ground as it is drawn: guessed from the floors of the models, or measured. */

import { BufferAttribute, Group, MathUtils, Mesh, MeshLambertMaterial, PlaneGeometry, type Ray } from "three";
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
  const { xMin, yMin, nx, ny, cellM, heights } = ground;
  const [width, depth] = [cellM * (nx - 1), cellM * (ny - 1)];
  const geometry = new PlaneGeometry(width, depth, nx - 1, ny - 1).translate(xMin + width / 2, yMin + depth / 2, 0);
  const [position, uv] = [geometry.getAttribute("position"), geometry.getAttribute("uv")];
  const colours = new Float32Array(4 * nx * ny).fill(1);
  for (let at = 0; at < nx * ny; at++) {
    const row = ny - 1 - Math.floor(at / nx); // the plane begins in the north
    // a little below the floors, which would otherwise flicker through
    position.setZ(at, heights[row * nx + (at % nx)] - 0.06);
    const fromMiddle = Math.hypot(2 * uv.getX(at) - 1, 2 * uv.getY(at) - 1);
    if (isGuessed) colours[4 * at + 3] = MathUtils.smoothstep(1 - fromMiddle, 0, 0.35);
  }
  geometry.setAttribute("color", new BufferAttribute(colours, 4));
  geometry.computeVertexNormals();
  // farther back than models are: outlines lie just above the ground, and would be hidden seen from afar
  const offset = { polygonOffset: true, polygonOffsetFactor: 3, polygonOffsetUnits: 3 };
  const mesh = new Mesh(geometry, new MeshLambertMaterial({ vertexColors: true, transparent: true, ...offset }));
  mesh.renderOrder = -1;
  return mesh;
}
