// @vitest-environment happy-dom
/** What the views of models do when the address changes while they load. The 3D view and the reader are stand-ins. */

import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";
import type { StatusInfo } from "../src/api/types";
import { showChanges } from "../src/changes/changes_view";
import type { Listed } from "../src/models/batching";
import type { FromLoading } from "../src/models/model_loading";
import { hashOf, partsOf } from "../src/page/address";
import { showResults } from "../src/results/results_view";
import type { Ground } from "../src/scene/ground";
import { FakeService, press, settled } from "./fake_service";

/** What was selected in the 3D views, and whether the camera flew there. */
const { scenes, loading } = vi.hoisted(() => ({
  scenes: [] as { open: (id: string | null) => void; selections: [string | null, boolean][]; terrain: Ground | null }[],
  loading: { read: (_onMessage: (message: unknown) => void): Promise<string[]> => Promise.resolve([]) },
}));

vi.mock("../src/scene/scene", () => ({
  ModelScene: class {
    readonly selections: [string | null, boolean][] = [];
    constructor(
      _canvas: unknown,
      readonly open: (id: string | null) => void,
    ) {
      scenes.push(this);
    }
    select(id: string | null, fly: boolean): void {
      this.selections.push([id, fly]);
    }
    readonly models = { has: (): boolean => true, showOnly: (): void => undefined, colourBy: (): void => undefined };
    groundAt = (): number => 0;
    terrain: Ground | null = null;
    lay(terrain: Ground): void {
      this.terrain = terrain;
    }
    add(): void {}
    finish(): void {}
    readonly camera = { watch: (): void => undefined, look: (): void => undefined };
    dispose(): void {}
  },
}));

vi.mock("../src/models/model_loading", () => ({
  loadModels: (_path: string, _reading: unknown, onMessage: (message: unknown) => void) => loading.read(onMessage),
}));

vi.mock("../src/models/rejected_objects", async (original) => {
  const { request } = await import("../src/api/requests");
  return {
    ...(await original<object>()),
    rejectedObjects: async (run: { jobPath: string }) => (await request(`${run.jobPath}/results/rejected`)).json(),
  };
});

const listed = (id: string, category: Listed["category"] = "gable"): Listed => ({ id, category, reason: null, reasonDetail: null, sourceId: null, figures: {}, flags: [] });

const buildings = (...objects: Listed[]): FromLoading => ({
  kind: "buildings",
  listed: objects,
  batches: [],
  outlines: [],
});

let service: FakeService;
let place: HTMLElement;
let leave: () => void = () => undefined;

beforeEach(() => {
  place = document.createElement("main");
  document.body.replaceChildren(place);
  scenes.length = 0;
  vi.clearAllMocks();
  service = new FakeService();
  location.hash = "";
});

afterEach(() => {
  leave();
  vi.unstubAllGlobals();
});

/** Go to an address; the page hears of it later. */
async function go(hash: string): Promise<void> {
  location.hash = hash;
  await settled();
}

describe("the results of a job", () => {
  const JOB: StatusInfo = { jobID: "1", status: "successful", title: "a town" };
  const TILESET = "GET jobs/1/points/tileset.json";
  const FAILED = "GET jobs/1/buildings?status=failed&limit=10000&crs=native";
  const REJECTED = "GET jobs/1/results/rejected";
  const SHED = { type: "Feature", id: "shed", geometry: null, properties: { object_id: "shed", reason: "too_small" } };

  beforeEach(() => {
    service.on("GET jobs/1/results/report", { counts: { rejected: 1 } });
    service.on("GET jobs/1/results", {});
    loading.read = (onMessage) => {
      onMessage(buildings(listed("a"), listed("b"), listed("c", "failed")));
      return Promise.resolve([]);
    };
    service.on(FAILED, { features: [] });
    for (const id of ["a", "b"]) service.on(`GET jobs/1/buildings/${id}`, { properties: { status: "ok" } });
  });

  async function open(building: string | null, query = ""): Promise<void> {
    await go(`#/jobs/1${building === null ? "" : `/buildings/${building}`}${query}`);
    leave = showResults(place, JOB, { job: "1", method: null, building });
    await settled();
  }

  const selections = (): (string | null)[] => (scenes[0]?.selections ?? []).map(([id]) => id);
  const alert = (): string => place.querySelector("[role=alert]")?.textContent ?? "";
  const isReady = (): boolean => place.querySelector("canvas")?.dataset["ready"] === "true";

  test("show the building that the address names once they are loaded, not the one that it named before", async () => {
    const held = service.hold(FAILED);
    await open("a");
    await go("#/jobs/1/buildings/b");
    held.give({ body: { features: [] } });
    await settled();
    expect(isReady()).toBe(true);
    expect(selections()).toEqual(["b"]);
  });

  test("keep the chosen building when an object that was looked for before arrives", async () => {
    await open(null);
    const held = service.hold(REJECTED);
    await go("#/jobs/1/buildings/shed");
    await go("#/jobs/1/buildings/b");
    held.give({ body: [SHED] });
    await settled();
    expect(selections()).toEqual(["b"]);
    await go("#/jobs/1/buildings/shed");
    expect(selections()).toEqual(["b", "shed"]);
    expect(place.querySelector(".record")?.textContent).toContain("Not a building");
  });

  test("look for an unknown building only once all are loaded", async () => {
    let finish: (levels: string[]) => void = () => undefined;
    let onMessage: (message: unknown) => void = () => undefined;
    loading.read = (take) => {
      onMessage = take;
      return new Promise((resolve) => (finish = resolve));
    };
    await open(null);
    onMessage(buildings(listed("a")));
    await go("#/jobs/1/buildings/b");
    expect(service.count(REJECTED)).toBe(0);
    expect(selections()).toEqual([]);
    onMessage(buildings(listed("b")));
    finish([]);
    await settled();
    expect(selections()).toEqual(["b"]);
    expect(service.count(REJECTED)).toBe(0);
  });

  test("are complete although the terrain does not come, and ask again", async () => {
    service.on("GET jobs/1/results", { tileset: {} });
    service.on(TILESET, { title: "Too busy" }, 503);
    await open("a");
    expect(selections()).toEqual(["a"]);
    expect(isReady()).toBe(true);
    expect(alert()).toContain("Too busy");
    expect(place.querySelector(".switches button")?.textContent).toBe("Points");
    service.on(TILESET, { extras: { terrain: "terrain.json" } });
    service.on("GET jobs/1/points/terrain.json", { origin_m: [0, 0], spacing_m: 1, elevation_unit_m: 0.01, elevations: [[150, 250]] });
    press("Try again");
    await settled();
    expect(alert()).toBe("");
    expect([...(scenes[0].terrain?.heights ?? [])]).toEqual([1.5, 2.5]);
  });

  test("choose the building although the footprints of the failed ones do not come", async () => {
    service.on(FAILED, { title: "Too busy" }, 503);
    await open("a");
    expect(alert()).toContain("Too busy");
    expect(selections()).toEqual(["a"]);
  });

  test("load the objects that were left out once more after a fault", async () => {
    service.on(REJECTED, { title: "Too busy" }, 503);
    await open(null, "?show=rejected");
    expect(alert()).toContain("Too busy");
    service.on(REJECTED, [SHED]);
    press("Try again");
    await settled();
    expect(alert()).toBe("");
    expect(place.querySelector('li[data-id="shed"]')).not.toBeNull();
    expect(service.count(REJECTED)).toBe(2);
  });

  test("find an object of an address after a fault, too", async () => {
    service.on(REJECTED, { title: "Too busy" }, 503);
    await open("shed");
    expect(alert()).toContain("Too busy");
    expect(selections()).toEqual([]);
    service.on(REJECTED, [SHED]);
    press("Try again");
    await settled();
    expect(selections()).toEqual(["shed"]);
  });
});

describe("two runs side by side", () => {
  const JOBS = "GET jobs?status=successful&processID=reconstruct%2Ccompare&limit=100";
  const two = hashOf(["changes"], { old: "1", new: "2" });

  beforeEach(() => {
    service.on(JOBS, { jobs: ["1", "2", "3"].map((jobID) => ({ jobID, status: "successful" })) });
    for (const job of ["1", "2", "3"]) service.on(`GET jobs/${job}/results/report`, {});
    loading.read = (onMessage) => {
      onMessage(buildings(listed("a"), listed("b")));
      return Promise.resolve([]);
    };
  });

  test("are not reported as a fault when others are chosen while they load", async () => {
    const held = service.hold("GET jobs/1/results/report");
    location.hash = two;
    const view = showChanges(place);
    view.follow(partsOf(two));
    leave = () => view.leave();
    await settled();
    view.follow(partsOf(hashOf(["changes"], { old: "2", new: "3" })));
    held.give({ body: {} });
    await settled();
    expect(place.querySelector("[role=alert]")).toBeNull();
    expect(place.querySelectorAll("canvas[data-ready]")).toHaveLength(2);
  });

  test("fly to a building of the list after a click on the chosen model", async () => {
    location.hash = two;
    const view = showChanges(place);
    view.follow(partsOf(two));
    leave = () => view.leave();
    await settled();
    const follow = (): void => view.follow(partsOf(location.hash));
    const right = scenes[1];
    right.open("a");
    follow();
    expect(right.selections.at(-1)).toEqual(["a", false]);
    right.open("a"); // the address stays
    location.hash = hashOf(["changes"], { old: "1", new: "2", building: "b" });
    follow();
    expect(right.selections.at(-1)).toEqual(["b", true]);
  });
});
