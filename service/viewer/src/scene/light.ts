/** Sun, sky and shadows. */

import { AmbientLight, DirectionalLight, Group, HemisphereLight, Vector3, type Box3 } from "three";

const TOWARDS_SUN = new Vector3(-0.75, -0.35, 1.0);
const SHADOW_M = 1500; // wider scenes get no shadows: their map would be too coarse

export class Light {
  readonly object = new Group();
  private readonly sun = new DirectionalLight("#fff6e8", 2.2);
  private readonly sky = new HemisphereLight("#f4f8ff", "#a89f92", 2.1);

  constructor() {
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(4096, 4096);
    this.object.add(this.sky, this.sun, this.sun.target, new AmbientLight("#ffffff", 0.25));
  }

  /** How bright sky and sun are. */
  set(sky: number, sun: number): void {
    this.sky.intensity = sky;
    this.sun.intensity = sun;
  }

  /** Shine on all that is within a box; true if it casts shadows, which are then to be drawn anew. */
  shineOn(bounds: Box3): boolean {
    const size = bounds.isEmpty() ? 0 : bounds.getSize(new Vector3()).length();
    this.sun.castShadow = size > 0 && size < SHADOW_M;
    if (!this.sun.castShadow) {
      this.sun.position.copy(TOWARDS_SUN);
      this.sun.target.position.set(0, 0, 0);
      return false;
    }
    const middle = bounds.getCenter(new Vector3());
    const radius = size / 2;
    this.sun.target.position.copy(middle);
    this.sun.position.copy(middle).addScaledVector(TOWARDS_SUN.clone().normalize(), 2 * radius);
    const { camera } = this.sun.shadow;
    camera.left = camera.bottom = -radius;
    camera.right = camera.top = radius;
    camera.near = 0.5 * radius;
    camera.far = 4 * radius;
    camera.updateProjectionMatrix();
    this.sun.shadow.normalBias = Math.min(0.4, radius / 1000);
    this.sun.shadow.bias = -0.0004;
    return true;
  }
}
