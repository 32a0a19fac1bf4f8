// @vitest-environment happy-dom
import { afterEach, beforeEach, expect, test, vi } from "vitest";
import { showHistory } from "../src/jobs/history";
import { partsOf } from "../src/page/address";
import type { Show, View } from "../src/page/view";
import { showSchedules } from "../src/service/schedules_view";
import { showWebhooks } from "../src/service/webhooks_view";
import { FakeService, press, settled } from "./fake_service";

let service: FakeService;
let place: HTMLElement;

beforeEach(() => {
  document.body.replaceChildren();
  place = document.body.appendChild(document.createElement("main"));
  vi.clearAllMocks();
  service = new FakeService();
});

afterEach(() => {
  vi.useRealTimers();
  vi.unstubAllGlobals();
});

function opened(show: Show, hash: string): View {
  const view = show(place, partsOf(hash));
  view.follow(partsOf(hash));
  return view;
}

const SCHEDULE = { scheduleID: "s", title: "nightly", cron: "0 2 * * *", timeZone: "UTC", state: "active", processID: "echo", nextTimes: [], counts: {}, version: 1 };
const JOBS = "GET jobs?limit=25&offset=0";
const RUNNING = { jobs: [{ jobID: "1", status: "running", title: "a town" }], numberMatched: 1, links: [] };
const LOG = "GET webhooks/deliveries?limit=25&offset=0";
const RECEIVERS = "GET webhooks?limit=1000";
const RECEIVER = { webhookID: "w", url: "https://a.example", description: "ours", events: [], enabled: true, created: "2026-01-01T00:00:00Z" };
const DELIVERY = { deliveryID: "d", jobID: "1", url: "https://a.example", type: "job.failed", title: "a job failed", state: "failed", created: "2026-01-01T00:00:00Z", attemptCount: 1 };

/** Choose an entry of the menu of this name. */
function choose(menu: string, words: string): void {
  const opener = place.querySelector<HTMLElement>(`summary[aria-label="Actions for ${menu}"]`);
  opener?.click();
  press(words, opener?.parentElement ?? place);
}

/** Each view; an action of it that the service answers late; what the view reads. */
const VIEWS = [
  {
    name: "the list of schedules",
    reads: "GET schedules?limit=25&offset=0",
    action: "PATCH schedules/s",
    open: () => {
      service.on("GET schedules?limit=25&offset=0", { schedules: [SCHEDULE], links: [] });
      return opened(showSchedules, "#/schedules");
    },
    act: () => choose("nightly", "Pause"),
  },
  {
    name: "a schedule",
    reads: "GET schedules/s",
    action: "PATCH schedules/s",
    open: () => {
      service.on("GET schedules/s", SCHEDULE);
      service.on("GET schedules/s/runs?limit=25&offset=0", { runs: [], links: [] });
      return opened(showSchedules, "#/schedules/s");
    },
    act: () => choose("nightly", "Pause"),
  },
  {
    name: "the history",
    reads: JOBS,
    action: "PATCH jobs/1",
    open: () => {
      service.on(JOBS, RUNNING);
      return opened(showHistory, "#/jobs");
    },
    act: () => choose("a town", "Keep it"),
  },
  {
    name: "the log of messages",
    reads: LOG,
    action: "POST webhooks/w/replay",
    open: () => {
      service.on(LOG, { deliveries: [DELIVERY], links: [] });
      service.on(RECEIVERS, { webhooks: [RECEIVER], eventTypes: [] });
      return opened(showWebhooks, "#/webhooks");
    },
    act: () => choose("ours", "Send what it missed"),
  },
  {
    name: "a message",
    reads: "GET webhooks/deliveries/d",
    action: "POST webhooks/deliveries/d/replay",
    open: () => {
      service.on("GET webhooks/deliveries/d", DELIVERY);
      return opened(showWebhooks, "#/webhooks/deliveries/d");
    },
    act: () => press("Send again"),
  },
];

for (const { name, reads, action, open, act } of VIEWS) {
  test(`an action that ends after ${name} was left reads nothing more`, async () => {
    const view = open();
    await settled();
    const held = service.hold(action);
    act();
    await settled();
    expect(service.count(action)).toBe(1);
    const before = service.count(reads);
    expect(before).toBeGreaterThan(0);
    view.leave();
    held.give({ body: {} });
    await settled();
    expect(service.count(reads)).toBe(before);
  });
}

test("a list with a job under way is read again while the service is away, and its notice stays one", async () => {
  vi.useFakeTimers();
  service.on(JOBS, RUNNING);
  const view = opened(showHistory, "#/jobs");
  await vi.advanceTimersByTimeAsync(1000);
  expect(place.querySelectorAll("tbody tr")).toHaveLength(1);
  vi.stubGlobal("fetch", () => Promise.reject(new TypeError("no network")));
  await vi.advanceTimersByTimeAsync(4000);
  const alert = place.querySelector("[role=alert]");
  expect(alert?.textContent).toContain("does not answer");
  await vi.advanceTimersByTimeAsync(4000);
  expect(place.querySelector("[role=alert]"), "it is read out anew").toBe(alert);
  service = new FakeService();
  service.on(JOBS, { ...RUNNING, jobs: [{ ...RUNNING.jobs[0], status: "successful" }] });
  await vi.advanceTimersByTimeAsync(4000);
  expect(place.querySelector("[role=alert]")).toBeNull();
  expect(place.querySelector("tbody")?.textContent).toContain("done");
  await vi.advanceTimersByTimeAsync(60_000);
  expect(service.count(JOBS), "nothing is under way").toBe(1);
  view.leave();
});

test("a view that was left is not read again by the clock", async () => {
  vi.useFakeTimers();
  service.on(JOBS, RUNNING);
  const view = opened(showHistory, "#/jobs");
  await vi.advanceTimersByTimeAsync(4500);
  expect(service.count(JOBS)).toBe(2);
  view.leave();
  await vi.advanceTimersByTimeAsync(60_000);
  expect(service.count(JOBS)).toBe(2);
});
