import { describe, expect, it } from "vitest";
import { ofRun, variantOf } from "../src/api/requests";
import { addressOf, placeOf } from "../src/page/address";
import { hasView } from "../src/views";

describe("addresses of the page", () => {
  const job = "3f2a9c0d5e6b47189a0b1c2d3e4f5a6b";

  it("lead to what they were made of", () => {
    for (const method of [null, "kmeans-faithful"]) {
      for (const building of [null, "3givd2mvtyerfjxv2yytjbmi"]) {
        const place = { job, method, building };
        expect(placeOf(addressOf(place))).toEqual(place);
      }
    }
  });

  it("are what they were before there were comparisons", () => {
    expect(addressOf({ job, method: null, building: "b" })).toBe(`#/jobs/${job}/buildings/b`);
    expect(placeOf(`#/jobs/${job}`)).toEqual({ job, method: null, building: null });
  });

  it("are none where no job is named", () => {
    for (const hash of ["", "#/", "#/jobs", "#/jobs/"]) expect(placeOf(hash)).toBeNull();
  });

  it("are read as far as they can be", () => {
    expect(placeOf("#/jobs/%zz/buildings/a%2Fb")).toEqual({ job: "%zz", method: null, building: "a/b" });
  });

  it("name a view only by a word that the page knows", () => {
    for (const name of ["jobs", "changes", "schedules", "webhooks"]) expect(hasView(name)).toBe(true);
    for (const name of ["", "nothing", "toString", "constructor"]) expect(hasView(name)).toBe(false);
  });
});

describe("paths of one run", () => {
  it("carry its label beside other parameters", () => {
    expect(ofRun("jobs/1/results", null)).toBe("jobs/1/results");
    expect(ofRun("jobs/1/results", "kmeans")).toBe("jobs/1/results?method=kmeans");
    expect(ofRun("jobs/1/buildings?limit=1", "a b")).toBe("jobs/1/buildings?limit=1&method=a%20b");
  });
});

describe("what a comparison runs", () => {
  it("names the preset only where it is not the usual one", () => {
    expect(variantOf("kmeans", "robust", "robust")).toBe("kmeans");
    expect(variantOf("kmeans", "faithful", "robust")).toBe("kmeans:faithful");
    expect(variantOf("kmeans", "", "robust")).toBe("kmeans");
  });
});
