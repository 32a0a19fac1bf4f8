import type { MeshLambertMaterial } from "three";

const SPACING_M = 1.6;

/** Draws dark slanted stripes over a material, as a sign in addition to the colour. */
export function hatched(material: MeshLambertMaterial): MeshLambertMaterial {
  material.onBeforeCompile = (shader) => {
    shader.vertexShader = shader.vertexShader
      .replace("#include <common>", "#include <common>\nvarying vec3 vHatched;")
      .replace("#include <begin_vertex>", "#include <begin_vertex>\nvHatched = position;");
    shader.fragmentShader = shader.fragmentShader
      .replace("#include <common>", "#include <common>\nvarying vec3 vHatched;")
      .replace(
        "#include <color_fragment>",
        `#include <color_fragment>
        float along = (vHatched.x + vHatched.y + vHatched.z) / ${SPACING_M.toFixed(2)};
        float blur = clamp(fwidth(along), 0.0, 0.5);
        float stripe = smoothstep(0.5 - blur, 0.5 + blur, abs(fract(along) * 2.0 - 1.0));
        diffuseColor.rgb *= mix(0.55, 1.0, stripe);`,
      );
  };
  return material;
}
