/** The ground as it is drawn: guessed from the floors of the models, or measured. */

import { Group, type Mesh, type MeshLambertMaterial, type Ray } from "three";
import { groundDistance, heightAt, type Ground } from "./ground";
import { groundMesh } from "./ground_mesh";

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
  distance({ origin, direction }: Ray): number {
    if (this.heights === null) return Infinity;
    return groundDistance(this.heights, origin.toArray(), direction.toArray()) ?? Infinity;
  }

  dispose(): void {
    this.mesh?.geometry.dispose();
  }
}
