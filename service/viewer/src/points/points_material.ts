import { Color, GLSL3, RawShaderMaterial } from "three";
import { CYCLE } from "../models/colouring";
import {
  classNumber,
  MOST_CLASSES,
  palette,
  POINT_COLOURING_NAMES,
  RESIDUAL_ENDS_MM,
  residualNumber,
  type PointColouring,
} from "./points_colouring";
import { NO_PLANE, NO_RESIDUAL, RESIDUAL_SHIFT } from "./points_glb";

const SIZE_M = 0.22; // of a point
const SMALLEST_PX = 1.5;
const LARGEST_PX = 9;
const LIFT_M = 0.35; // towards the eye: points on a roof are seen, points behind it are not
const CODES = 32; // class codes with a meaning of their own

const CLASS_NUMBERS = Array.from({ length: CODES }, (_, code) => classNumber(code));
const NUMBER = Object.fromEntries(POINT_COLOURING_NAMES.map((name, i) => [name, i])) as Record<PointColouring, number>;

const VERTEX = `
precision highp float;
uniform mat4 modelMatrix;
uniform mat4 modelViewMatrix;
uniform mat4 projectionMatrix;
uniform float pixelsPerMetre;
uniform float pixelRatio;
uniform int colouring;
uniform vec2 heights;
uniform vec3 palette[${MOST_CLASSES}];
uniform int hidden[${MOST_CLASSES}];
in vec4 position; // and class
in vec2 labels; // plane, residual
flat out vec3 colour;

const int CLASS_NUMBERS[${CODES}] = int[](${CLASS_NUMBERS.join(", ")});

int number() {
  if (colouring == ${NUMBER.class}) {
    int code = int(position.w);
    return code < ${CODES} ? CLASS_NUMBERS[code] : ${classNumber(CODES)};
  }
  if (colouring == ${NUMBER.plane}) return labels.x == ${NO_PLANE}.0 ? ${CYCLE.length} : int(mod(labels.x, ${CYCLE.length}.0));
  if (labels.y == ${NO_RESIDUAL}.0) return ${RESIDUAL_ENDS_MM.length + 1};
  float residual = labels.y - ${RESIDUAL_SHIFT}.0;
  int below = 0;
  ${RESIDUAL_ENDS_MM.map((end) => `if (residual > ${end}.0) below++;`).join(" ")}
  return below;
}

void main() {
  vec4 seen = modelViewMatrix * vec4(position.xyz, 1.0);
  float away = length(seen.xyz);
  bool unseen = false;
  if (colouring == ${NUMBER.height}) {
    float height = (modelMatrix * vec4(position.xyz, 1.0)).z;
    float at = clamp((height - heights.x) / max(heights.y - heights.x, 0.001), 0.0, 1.0) * 7.0;
    int step = min(int(at), 6);
    colour = mix(palette[step], palette[step + 1], at - float(step));
  } else {
    int which = number();
    colour = palette[which];
    unseen = hidden[which] == 1;
  }
  seen.xyz *= max(1.0 - ${LIFT_M} / max(away, 0.001), 0.5);
  gl_Position = unseen ? vec4(2.0, 2.0, 2.0, 1.0) : projectionMatrix * seen;
  gl_PointSize = clamp(${SIZE_M} * pixelsPerMetre / away, ${SMALLEST_PX.toFixed(1)} * pixelRatio, ${LARGEST_PX.toFixed(1)} * pixelRatio);
}
`;

const FRAGMENT = `
precision mediump float;
flat in vec3 colour;
out vec4 drawn;
void main() {
  vec2 from = gl_PointCoord - 0.5;
  if (dot(from, from) > 0.25) discard;
  drawn = vec4(colour, 1.0);
}
`;

/** Draws points as discs, smaller farther away, in the colours of their classes. */
export class PointsMaterial extends RawShaderMaterial {
  constructor() {
    super({
      glslVersion: GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: {
        pixelsPerMetre: { value: 1 },
        pixelRatio: { value: 1 },
        colouring: { value: 0 },
        heights: { value: [0, 1] },
        palette: { value: Array.from({ length: MOST_CLASSES }, () => new Color(0, 0, 0)) },
        hidden: { value: new Int32Array(MOST_CLASSES) },
      },
    });
  }

  /** Choose what the colours show; all classes are shown then. */
  colourBy(colouring: PointColouring): void {
    this.uniforms["colouring"].value = NUMBER[colouring];
    const colours = this.uniforms["palette"].value as Color[];
    // the screen's own values: the shader writes them as they are
    palette(colouring).forEach((colour, i) => colours[i].setStyle(colour, "srgb-linear"));
    (this.uniforms["hidden"].value as Int32Array).fill(0);
  }

  /** Show or hide classes by their numbers. */
  show(numbers: readonly number[], visible: boolean): void {
    for (const number of numbers) (this.uniforms["hidden"].value as Int32Array)[number] = visible ? 0 : 1;
  }

  /** Whether a point is of a hidden class: the shader's rule, for the values of `NodePoints`. */
  hides(code: number, plane: number, residual: number): boolean {
    const numbers: Record<PointColouring, () => number> = {
      residual: () => residualNumber(residual === NO_RESIDUAL ? NaN : residual - RESIDUAL_SHIFT),
      plane: () => (plane === NO_PLANE ? CYCLE.length : plane % CYCLE.length),
      class: () => classNumber(code),
      height: () => -1, // has no classes
    };
    const colouring = POINT_COLOURING_NAMES[this.uniforms["colouring"].value as number];
    return (this.uniforms["hidden"].value as Int32Array)[numbers[colouring]()] === 1;
  }
}
