import { describe, expect, test } from "vitest";
import { hashOf, partsOf } from "../src/page/address";
import { offsetOf, pageWords } from "../src/page/paging";
import { bodyText, DELIVERY_REMEDIES } from "../src/service/delivery_view";
import { clockWords, countWords, slotWords, tileLines, withTiles } from "../src/service/schedules";

describe("addresses of lists", () => {
  test("lead to what they were made of, whatever is searched", () => {
    const query = { q: "Delft & West #1/2?", status: "failed", empty: "" };
    const found = partsOf(hashOf(["jobs"], query));
    expect([found.name, found.rest]).toEqual(["jobs", []]);
    expect(Object.fromEntries(found.query)).toEqual({ q: query.q, status: "failed" });
    expect(partsOf(hashOf(["webhooks", "deliveries", "a/b"])).rest).toEqual(["deliveries", "a/b"]);
  });

  test("of the start have no name, and a broken one is read as far as it can be", () => {
    for (const hash of ["", "#", "#/"]) expect(partsOf(hash).name).toBe("");
    expect(partsOf("#/schedules/%zz").rest).toEqual(["%zz"]);
  });
});

describe("pages of a list", () => {
  test("name their first and last entry, and all if they are counted", () => {
    expect(pageWords(25, 25, 1312)).toBe("26 to 50 of 1\u202f312");
    expect(pageWords(50, 1, 51)).toBe("51 of 51");
    expect(pageWords(0, 3, null)).toBe("1 to 3");
    expect(pageWords(0, 0, 0)).toBe("");
  });

  test("begin at 0 if the address names no other place", () => {
    for (const text of [null, "", "x", "-5", "1.5", "1e99"]) expect(offsetOf(text)).toBe(0);
    expect(offsetOf("50")).toBe(50);
  });
});

describe("schedules", () => {
  test("show times by the clock of their zone", () => {
    expect(clockWords("2026-12-03T01:30:00.000Z", "Europe/Amsterdam")).toBe("Thu 2026-12-03 02:30");
    expect(clockWords("2026-07-01T23:30:00.000Z", "Europe/Amsterdam")).toBe("Thu 2026-07-02 01:30");
    expect(clockWords("2026-12-03T01:30:00.000Z", "Nowhere/Atlantis")).toBe("Thu 2026-12-03 01:30 UTC");
  });

  test("say how a run came about and what happened up to now", () => {
    const run = { number: 1, outcome: "missed", at: "", message: "", slots: 1, trigger: "clock" as const };
    expect(slotWords(run)).toBe("");
    expect(slotWords({ ...run, trigger: "hand" })).toBe("by hand");
    expect(slotWords({ ...run, slots: 3 })).toBe("3 times together");
    expect(slotWords({ ...run, slots: 1000, moreSlots: true })).toBe("at least 1\u202f000 times together");
    expect(countWords({ submitted: 2, skipped: 0, missed: 1 })).toBe("2 started, 1 missed");
  });

  test("repeat a request with other files", () => {
    const inputs = { tiles: [{ href: "https://a.example/1.laz" }], crs: "EPSG:28992" };
    expect(tileLines(inputs)).toBe("https://a.example/1.laz");
    expect(withTiles(inputs, " https://b.example/1.laz \n\nhttps://b.example/2.laz")).toEqual({
      tiles: [{ href: "https://b.example/1.laz" }, { href: "https://b.example/2.laz" }],
      crs: "EPSG:28992",
    });
    expect(tileLines({})).toBe("");
  });
});

describe("messages", () => {
  test("that did not arrive have a remedy, the others have none", () => {
    expect(Object.keys(DELIVERY_REMEDIES)).toEqual(["failed", "gone", "dropped"]);
  });

  test("are laid out if they are JSON, and shown as they were sent if not", () => {
    expect(bodyText('{"a":1}')).toBe('{\n  "a": 1\n}');
    expect(bodyText("a=1")).toBe("a=1");
  });
});
