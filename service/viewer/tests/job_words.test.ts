import { expect, test, vi } from "vitest";
import type { StatusInfo } from "../src/api/types";
import { durationWords, failureRemedy, resultWords, statusWords, titleOf } from "../src/jobs/job_words";

const job = (more: Partial<StatusInfo>): StatusInfo => ({ jobID: "3f2a9c0d5e6b47189a0b1c2d3e4f5a6b", status: "successful", ...more });

test("a job without a title is named by the beginning of its id", () => {
  expect(titleOf(job({}))).toBe("Job 3f2a9c0d");
  expect(titleOf(job({ title: "Delft" }))).toBe("Delft");
});

test("only a job that runs shows its progress", () => {
  expect(statusWords(job({ status: "running", progress: 41 }))).toBe("running 41\u202f%");
  expect(statusWords(job({ status: "dismissed", progress: 41 }))).toBe("cancelled");
});

test("results are counted by what the process makes", () => {
  const statuses = { ok: 44, doubtful: 3, fallback: 2, failed: 1 };
  expect(resultWords(job({ summary: { statuses } }))).toBe("50 buildings · 3 doubtful · 2 blocks · 1 failed");
  expect(resultWords(job({ summary: { statuses: { ok: 1, fallback: 0, failed: 0 } } }))).toBe("1 building");
  expect(resultWords(job({ summary: { runs: { a: { statuses }, b: { statuses } } } }))).toBe("2 methods · 50 buildings · 3 doubtful · 2 blocks · 1 failed");
  expect(resultWords(job({ summary: { classes: { "2": 1000, "6": 500 } } }))).toBe("1\u202f500 points");
  expect(resultWords(job({ summary: {} }))).toBe("");
  expect(resultWords(job({ status: "running" }))).toBe("");
  expect(resultWords(job({ status: "failed", exception: { title: "An input could not be used" } }))).toBe("An input could not be used");
});

test("a job that runs counts up to now, one that never ran does not count", () => {
  const started = "2026-03-01T09:00:00.000Z";
  vi.useFakeTimers({ now: new Date("2026-03-01T09:01:30.000Z") });
  expect(durationWords(job({ started }))).toBe("1\u202fmin 30\u202fs");
  expect(durationWords(job({ started, finished: "2026-03-01T09:00:12.000Z" }))).toBe("12\u202fs");
  expect(durationWords(job({}))).toBe("");
  vi.useRealTimers();
});

test("every cause of a failure has its own remedy", () => {
  const kinds = ["input", "settings", "refused", "cluster", "lost", "no-space", "internal"];
  const remedies = kinds.map((kind) => failureRemedy(job({ exception: { type: `urn:gablework:problem:job-failed-${kind}` } })));
  expect(new Set(remedies).size).toBe(kinds.length);
  expect(remedies).not.toContain(failureRemedy(job({})));
});
