import type { Box } from "../models/plan";

const MOST_PX_PER_M = 120;
const LEAST_PX_PER_M = 1e-4;

/** The part of a plane that a map shows: north up, y of the map downwards. */
export class MapView {
  /** The place in the middle. */
  east = 0;
  north = 0;
  /** Pixels of the page per metre. */
  scale = 1;
  /** In pixels of the page. */
  width = 0;
  height = 0;

  copy(): MapView {
    return Object.assign(new MapView(), this);
  }

  /** Show the same as another view, in this one's size. */
  become({ east, north, scale }: MapView): void {
    Object.assign(this, { east, north, scale });
  }

  /** The view around a box, at `room` times its size and of at least `least` metres. */
  around([x0, y0, x1, y1]: Box, room: number, least: number): MapView {
    const [wide, high] = [Math.max(x1 - x0, least) * room, Math.max(y1 - y0, least) * room];
    const view = this.copy();
    view.east = (x0 + x1) / 2;
    view.north = (y0 + y1) / 2;
    view.scale = limited(Math.min(Math.max(this.width, 1) / wide, Math.max(this.height, 1) / high));
    return view;
  }

  /** Become a view on the way between two others; the zoom is even in its logarithm. */
  between(start: MapView, end: MapView, share: number): void {
    this.scale = start.scale * (end.scale / start.scale) ** share;
    // what is in the middle of the way moves evenly over the page
    const zoomed = Math.abs(end.scale / start.scale - 1) < 1e-6;
    const along = zoomed ? share : (1 / this.scale - 1 / start.scale) / (1 / end.scale - 1 / start.scale);
    this.east = start.east + along * (end.east - start.east);
    this.north = start.north + along * (end.north - start.north);
  }

  /** Move by pixels. */
  pan(dx: number, dy: number): void {
    this.east -= dx / this.scale;
    this.north += dy / this.scale;
  }

  /** Zoom; the place at x, y of the map stays there. */
  zoom(factor: number, x: number, y: number): void {
    const [east, north] = this.place(x, y);
    this.scale = limited(this.scale * factor);
    const [now, above] = this.place(x, y);
    this.east += east - now;
    this.north += north - above;
  }

  /** Easting and northing at a place of the map. */
  place(x: number, y: number): [number, number] {
    return [this.east + (x - this.width / 2) / this.scale, this.north - (y - this.height / 2) / this.scale];
  }

  /** The place of the map at an easting and northing. */
  pixel(east: number, north: number): [number, number] {
    return [this.width / 2 + (east - this.east) * this.scale, this.height / 2 - (north - this.north) * this.scale];
  }

  /** The affine map from metres to pixels, as a canvas takes it. */
  matrix(): [number, number, number, number, number, number] {
    const { east, north, scale, width, height } = this;
    return [scale, 0, 0, -scale, width / 2 - east * scale, height / 2 + north * scale];
  }

  /** What is seen. */
  box(): Box {
    const [west, north] = this.place(0, 0);
    const [east, south] = this.place(this.width, this.height);
    return [west, south, east, north];
  }
}

function limited(scale: number): number {
  return Math.min(Math.max(scale, LEAST_PX_PER_M), MOST_PX_PER_M);
}

/** The length of a scale bar of 50 to 125 pixels: 1, 2 or 5 times a power of ten. */
export function scaleBar(pixelsPerMetre: number): { metres: number; pixels: number } {
  const most = 125 / pixelsPerMetre;
  const power = 10 ** Math.floor(Math.log10(most));
  const metres = (most >= 5 * power ? 5 : most >= 2 * power ? 2 : 1) * power;
  return { metres: Number(metres.toPrecision(1)), pixels: metres * pixelsPerMetre };
}
