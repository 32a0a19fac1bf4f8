// @vitest-environment happy-dom
import { afterEach, beforeEach, expect, test, vi } from "vitest";
import { downloadMenu } from "../src/jobs/downloads";
import { FakeService } from "./fake_service";

const ALL = { buildings: { href: "", bytes: 2000 }, report: { href: "", bytes: 10 } };
const BUSY = { type: "urn:gablework:problem:selection-busy", title: "The selection is being made" };
let service: FakeService;

beforeEach(() => {
  vi.useFakeTimers();
  document.body.replaceChildren();
  service = new FakeService();
  service.on("GET jobs/1/results", ALL);
});

afterEach(() => {
  vi.useRealTimers();
  vi.unstubAllGlobals();
});

async function menu(statuses: Record<string, number>): Promise<HTMLElement> {
  return document.body.appendChild(await downloadMenu({ jobPath: "jobs/1", method: null }, statuses, new AbortController().signal));
}

function links(): string[] {
  return [...document.querySelectorAll("a")].map((link) => link.getAttribute("href")?.split("/jobs/")[1] ?? "");
}

async function tick(box: HTMLInputElement): Promise<void> {
  box.click();
  await vi.advanceTimersByTimeAsync(0);
}

test("the outputs of the buildings that are ok alone are offered once they are made, and all again afterwards", async () => {
  await menu({ ok: 44, doubtful: 3, fallback: 0, failed: 0 });
  const box = document.querySelector("input") as HTMLInputElement;
  expect(box.closest("label")?.textContent).toBe(" Only the 44 models that are ok");
  service.on("GET jobs/1/results?status=ok", BUSY, 503);
  await tick(box);
  expect(links()).toEqual([]);
  expect(document.querySelector("[role=status]")?.textContent).toContain("being made");
  service.on("GET jobs/1/results?status=ok", { buildings: { href: "", bytes: 900 } });
  await vi.advanceTimersByTimeAsync(2000);
  expect(links()).toEqual(["1/results/buildings?status=ok"]);
  await tick(box);
  expect(links()).toEqual(["1/results/buildings", "1/results/report"]);
});

test("a fault of a selection is said, and the other outputs come back", async () => {
  await menu({ ok: 1, failed: 1 });
  const box = document.querySelector("input") as HTMLInputElement;
  expect(box.closest("label")?.textContent).toBe(" Only the 1 model that is ok");
  service.on("GET jobs/1/results?status=ok", { title: "The disk is full" }, 507);
  await tick(box);
  expect(document.body.textContent).toContain("The disk is full");
  await tick(box);
  expect(links()).toHaveLength(2);
});

test("where all buildings are ok, or none is, there is nothing to choose", async () => {
  await menu({ ok: 44, doubtful: 0 });
  await menu({ doubtful: 4 });
  await menu({});
  expect(document.querySelectorAll("input")).toHaveLength(0);
});
