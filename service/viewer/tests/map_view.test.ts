import { describe, expect, it } from "vitest";
import { MapView, scaleBar } from "../src/map/map_view";

function view(): MapView {
  return Object.assign(new MapView(), { width: 800, height: 600, east: 100, north: 50, scale: 2 });
}

describe("a view of the map", () => {
  it("has north up, and its matrix undoes its places", () => {
    expect(view().place(400, 300)).toEqual([100, 50]);
    expect(view().place(400, 0)).toEqual([100, 200]);
    const [a, b, c, d, e, f] = view().matrix();
    const [east, north] = view().place(123, 456);
    expect([a * east + c * north + e, b * east + d * north + f]).toEqual([123, 456]);
  });

  it("keeps the place under the pointer when it zooms, and stops at its limits", () => {
    const zoomed = view();
    const before = zoomed.place(700, 100);
    zoomed.zoom(3, 700, 100);
    expect(zoomed.scale).toBe(6);
    zoomed.place(700, 100).forEach((value, axis) => expect(value).toBeCloseTo(before[axis], 9));
    zoomed.zoom(1e9, 0, 0);
    expect(zoomed.scale).toBe(120);
  });

  it("moves with the pointer", () => {
    const moved = view();
    const [east, north] = moved.place(10, 20);
    moved.pan(30, -40);
    expect(moved.place(40, -20)).toEqual([east, north]);
  });

  it("around a box shows all of it", () => {
    const around = view().around([0, 0, 400, 100], 1.1, 30);
    const [west, south, east, north] = around.box();
    expect(west).toBeLessThan(0);
    expect(east).toBeGreaterThan(400);
    expect(south).toBeLessThan(0);
    expect(north).toBeGreaterThan(100);
    expect(east - west).toBeCloseTo(440, 9);
    expect(view().around([5, 5, 5, 5], 1, 30).scale).toBe(20); // a point: 30 m
  });

  it("between two others goes from the one to the other", () => {
    const [start, end] = [view(), view().around([1000, 1000, 1010, 1010], 1, 10)];
    for (const [share, wanted] of [[0, start], [1, end]] as const) {
      const between = view();
      between.between(start, end, share);
      expect(between.east).toBeCloseTo(wanted.east, 6);
      expect(between.north).toBeCloseTo(wanted.north, 6);
      expect(between.scale).toBeCloseTo(wanted.scale, 6);
    }
    const moved = start.copy();
    moved.pan(100, 0);
    const half = view();
    half.between(start, moved, 0.5);
    expect(half.east).toBeCloseTo((start.east + moved.east) / 2, 9);
  });
});

it("a scale bar has a round length of 50 to 125 pixels", () => {
  for (let scale = 0.0007; scale < 100; scale *= 1.13) {
    const { metres, pixels } = scaleBar(scale);
    expect(pixels).toBeGreaterThanOrEqual(49.99);
    expect(pixels).toBeLessThanOrEqual(125.01);
    expect(pixels / scale / metres).toBeCloseTo(1, 9);
    expect([1, 2, 5]).toContain(Number(metres.toExponential()[0]));
  }
});
