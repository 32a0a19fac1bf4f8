// @vitest-environment happy-dom
import { afterEach, beforeEach, expect, test, vi } from "vitest";
import type { StatusInfo } from "../src/api/types";
import { cancellation, jobMenu } from "../src/jobs/job_actions";
import { JOBS_CHANGED } from "../src/page/view";
import { showJob } from "../src/progress/job_view";
import { FakeService, press, settled } from "./fake_service";

const WAITING: StatusInfo = { jobID: "1", status: "accepted", title: "a town" };
const onChange = vi.fn();
let service: FakeService;

beforeEach(() => {
  document.body.replaceChildren();
  vi.clearAllMocks();
  document.addEventListener(JOBS_CHANGED, onChange);
  service = new FakeService();
  service.on("DELETE jobs/1", { ...WAITING, status: "dismissed" });
});

afterEach(() => {
  vi.unstubAllGlobals();
});

test("a job that has begun meanwhile is stopped only after a question", async () => {
  service.on("GET jobs/1", { ...WAITING, status: "running" });
  await cancellation(WAITING);
  expect(service.count("DELETE jobs/1")).toBe(0);
  expect(document.querySelector("dialog")?.textContent).toContain("“a town” is running");
  press("Cancel the job");
  await settled();
  expect(service.count("DELETE jobs/1")).toBe(1);
  expect(document.querySelector("dialog")).toBeNull();
});

test("a job that waits is stopped at once", async () => {
  service.on("GET jobs/1", WAITING);
  await cancellation(WAITING);
  expect(service.count("DELETE jobs/1")).toBe(1);
  expect(onChange).toHaveBeenCalledOnce();
});

test("a second click does not remove the job that the first stops", async () => {
  service.on("GET jobs/1", { ...WAITING, processID: "echo" });
  service.hold("GET jobs/1/events");
  const place = document.body.appendChild(document.createElement("main"));
  const view = showJob(place, { job: "1", method: null, building: null });
  await settled();
  press("Cancel the job");
  press("Cancel the job");
  await settled();
  expect(service.count("DELETE jobs/1")).toBe(1);
  view.leave();
});

test("a job that has ended meanwhile keeps its results, before the question and after it", async () => {
  service.on("GET jobs/1", { ...WAITING, status: "successful" });
  await cancellation(WAITING);
  expect(document.querySelector("dialog")).toBeNull();
  service.on("GET jobs/1", { ...WAITING, status: "running" });
  await cancellation(WAITING);
  service.on("GET jobs/1", { ...WAITING, status: "successful" });
  press("Cancel the job");
  await settled();
  expect(service.count("DELETE jobs/1")).toBe(0);
  expect(onChange).toHaveBeenCalledTimes(2);
});

test("a menu offers what fits the job as it is after it was kept", async () => {
  const menu = jobMenu({ ...WAITING, request: { inputs: { crs: "EPSG:28992" } } });
  document.body.append(menu);
  service.on("PATCH jobs/1", { ...WAITING, status: "failed", keep: true });
  menu.querySelector("summary")?.click();
  expect(menu.textContent).toContain("Cancel…");
  press("Keep it");
  await settled();
  menu.querySelector("summary")?.click();
  expect([...menu.querySelectorAll("button")].map(({ textContent }) => textContent)).toEqual(["Try again…", "No longer keep it", "Remove…"]);
});
