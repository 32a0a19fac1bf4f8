// @vitest-environment happy-dom

import { afterEach, describe, expect, it, vi } from "vitest";
import { elevationUnitM, inMetres, modelUnits } from "../src/models/units";
import { showRecord } from "../src/results/record";

const FOOT_M = 1200 / 3937;

describe("units", () => {
  it("of models are those of the CityJSON, of older reports those of the tables", () => {
    const crs = { horizontal_unit_m: 1, vertical_unit_m: FOOT_M };
    expect(modelUnits({ ...crs, cityjson_vertical_unit_m: 1 })).toEqual({ horizontalUnitM: 1, verticalUnitM: 1 });
    expect(modelUnits(crs)).toEqual({ horizontalUnitM: 1, verticalUnitM: FOOT_M });
    expect(modelUnits(undefined)).toEqual({ horizontalUnitM: 1, verticalUnitM: 1 });
    expect([elevationUnitM(crs), elevationUnitM(null)]).toEqual([FOOT_M, 1]);
  });

  it("of a value that is no number are none", () => {
    expect([inMetres(10, FOOT_M), inMetres(null, FOOT_M)]).toEqual([10 * FOOT_M, null]);
  });
});

describe("a record", () => {
  afterEach(() => vi.unstubAllGlobals());

  it("shows elevations in metres, as its heights, where the tiles have feet", async () => {
    const properties = { status: "ok", roof_type: "flat", height_m: 6.04, ground_z: 328, ridge_z: 347.816, valid: true };
    const feature = { type: "Feature", id: "a", geometry: null, properties };
    vi.stubGlobal("fetch", vi.fn(async () => Response.json(feature)));
    const place = document.createElement("div");
    const stop = showRecord(place, { jobPath: "jobs/1", method: null }, "a", FOOT_M);
    await vi.waitFor(() => expect(place.textContent).toContain("Ridge above floor"));
    stop();
    const text = place.textContent.replace(/\u202f/g, " ");
    expect(text).toContain("Ridge above floor6.04 m");
    expect(text).toContain("Ground99.97 m");
    expect(text).not.toContain("ft");
  });
});
