import { el, svg } from "./elements";

/** The content in place of the models, before there is a job. */
export function welcome(): HTMLElement {
  return el(
    "div",
    { class: "welcome" },
    drawing(),
    el("h1", {}, "A LiDAR tile in, building models out"),
    el("p", { class: "lead" }, "Valid LoD2 solids from raw airborne point clouds. No classification and no footprints needed; both are used when given."),
    el(
      "ol",
      { class: "steps" },
      step("Drop a tile", "LAS, LAZ, COPC, PLY or plain x y z. Its header is checked at once."),
      step("Reconstruct", "Ground, roofs and walls are found; every step is shown."),
      step("View and download", "Models in 3D by roof type, each with its record; GeoParquet, CityJSON, OBJ, GeoJSON."),
    ),
  );
}

function step(title: string, text: string): HTMLElement {
  return el("li", {}, el("strong", {}, title), el("span", {}, text));
}

type Place = readonly [number, number, number];

const [LENGTH, WIDTH, EAVE, RIDGE] = [9.4, 6.8, 4.2, 7.6]; // metres of the drawn house
const SCALE = 13;

/** The same gable house twice: as measured points, and as the model made from them. */
function drawing(): SVGElement {
  const points: SVGElement[] = [];
  for (let i = 0; i < 420; i++) {
    // a scatter that looks measured and never changes: two low-discrepancy sequences
    const x = ((i * 0.754_877_666) % 1) * (LENGTH + 5) - 2.5;
    const y = ((i * 0.569_840_291) % 1) * (WIDTH + 5) - 2.5;
    const onRoof = x > 0 && x < LENGTH && y > 0 && y < WIDTH;
    const z = onRoof ? EAVE + (RIDGE - EAVE) * (1 - Math.abs((2 * y) / WIDTH - 1)) : 0;
    const [u, v] = projected([x, y, z + (((i * 29) % 11) / 11 - 0.5) * 0.25], 118);
    points.push(svg("circle", { class: onRoof ? "point-roof" : "point-ground", cx: u, cy: v, r: 1.6 }));
  }
  const face = (name: string, ...corners: Place[]): SVGElement =>
    svg("polygon", { class: name, points: corners.map((corner) => projected(corner, 362).join(",")).join(" ") });
  const [l, w, e, r] = [LENGTH, WIDTH, EAVE, RIDGE];
  return svg(
    "svg",
    { viewBox: "0 0 470 235", class: "drawing", "aria-hidden": "true" },
    ...points,
    svg("path", { class: "drawing-arrow", d: "M226 122h28m-8-7 8 7-8 7" }),
    face("drawing-shadow", [l, w, 0], [l + 3, w - 1.4, 0], [l + 3, -1.4, 0], [l, 0, 0]),
    face("drawing-back", [0, 0, e], [l, 0, e], [l, w / 2, r], [0, w / 2, r]),
    face("drawing-wall", [0, w, 0], [l, w, 0], [l, w, e], [0, w, e]),
    face("drawing-gable", [l, 0, 0], [l, w, 0], [l, w, e], [l, w / 2, r], [l, 0, e]),
    face("drawing-roof", [0, w, e], [l, w, e], [l, w / 2, r], [0, w / 2, r]),
  );
}

/** Parallel projection, seen from the north-east and above. */
function projected([x, y, z]: Place, middle: number): [string, string] {
  const [dx, dy] = [x - LENGTH / 2, y - WIDTH / 2];
  const u = middle + SCALE * (0.81 * dx - 0.59 * dy);
  const v = 140 + SCALE * (0.295 * dx + 0.405 * dy - 0.87 * z);
  return [u.toFixed(1), v.toFixed(1)];
}
