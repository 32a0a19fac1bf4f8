import { expect, test } from "vitest";
import { problemOf } from "../src/api/requests";
import { inFields } from "../src/words/fields";
import { bytes, count, counted, duration, measure, placeWords } from "../src/words/numbers";
import { CATEGORIES, categoryOf } from "../src/words/roof_types";

test("numbers are grouped and carry their unit", () => {
  expect(count(1234567)).toBe("1\u202f234\u202f567");
  expect(counted(1, "building")).toBe("1 building");
  expect(counted(0, "building")).toBe("0 buildings");
  expect(measure(1969.44, 1, "m²")).toBe("1\u202f969.4\u202fm²");
  expect(measure(-0.04, 1, "m")).toBe("0.0\u202fm");
  expect(measure(-3.25, 2)).toBe("−3.25");
  expect(measure(null, 2, "m")).toBe("–");
  expect(bytes(999)).toBe("999\u202fB");
  expect(bytes(4_300_000_000)).toBe("4.3\u202fGB");
  expect(duration(200)).toBe("3\u202fmin 20\u202fs");
});

test("a building that is not ok is described by its status, whatever its roof type", () => {
  expect(categoryOf("ok", "hip")).toBe("hip");
  expect(categoryOf("fallback", "flat")).toBe("fallback");
  expect(categoryOf("doubtful", "gable")).toBe("doubtful");
  expect(categoryOf("failed", "none")).toBe("failed");
  expect(categoryOf("ok", "onion")).toBe("unknown");
});

test("no two categories share a colour", () => {
  const colours = Object.values(CATEGORIES).map(({ colour }) => colour);
  expect(new Set(colours).size).toBe(colours.length);
});

test("a problem document is shown with what to do, anything else with its status", () => {
  const refused = problemOf(413, "", '{"title":"Too large","detail":"9 GB, 4 GB are taken"}', null);
  expect([refused.title, refused.detail]).toEqual(["Too large", "9 GB, 4 GB are taken"]);
  expect(refused.remedy).toContain("Split the tile");
  expect(problemOf(429, "Too Many Requests", "<html>", "7").remedy).toBe("Try again in 7 seconds.");
  expect(problemOf(502, "Bad Gateway", "", null).title).toBe("Bad Gateway");
  expect(problemOf(500, "", "null", null).title).toBe("Status 500");
});

test("messages name the fields of the page, not inputs of a process or settings of the operator", () => {
  expect(inFields("no usable CRS in the file; give the input crs")).toBe("no usable CRS in the file; set “CRS” under Options");
  expect(inFields("Give the right CRS with the input crs, or give the input allowOutsideAreaOfUse if it is")).toBe(
    "Give the right CRS in “CRS” under Options, or set “Use the tiles where they lie” under Options if it is",
  );
  for (const unknown of ["Check the input bbox", "Check the input constructor"]) expect(inFields(unknown)).toBe(unknown);
  expect(inFields("cut it into tiles, or raise GABLEWORK_MAX_POINTS")).toBe(
    "cut it into tiles, or ask the operator of this service to raise the limit",
  );
});

test("problems about keys say what a user can do", () => {
  const body = { type: "urn:gablework:problem:unauthorized", title: "A key is needed", detail: "Send the header `Authorization`" };
  const refused = problemOf(401, "", JSON.stringify(body), null);
  expect([refused.kind, refused.title, refused.detail]).toEqual(["unauthorized", "This service needs a key", ""]);
  expect(refused.remedy).not.toMatch(/header|gablework keys/);
});

test("problems with a remedy of their own do not speak of keys", () => {
  const body = { type: "urn:gablework:problem:target-refused", title: "Webhooks are not sent to this URL", detail: "http://a: give an https URL, or add http://a to GABLEWORK_WEBHOOK_HOSTS" };
  const refused = problemOf(403, "", JSON.stringify(body), null);
  expect(refused.remedy).toContain("another URL");
  expect(inFields(refused.detail)).toBe("http://a: give an https URL");
  const gone = problemOf(404, "", '{"type": "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0/no-such-job"}', null);
  expect(gone.kind).toBe("no-such-job");
});

test("a place is shown with its latitude first", () => {
  expect(placeWords({ longitude: 99.206, latitude: -75.981 })).toBe("75.98°\u202fS, 99.21°\u202fE");
  expect(placeWords(null)).toBeNull();
});

test("a message about layers names the field of the page", () => {
  expect(inFields("2 layers could be the footprints: give the input footprintsLayer, one of houses, sheds")).toBe(
    "2 layers could be the footprints: set “Layer of the footprints” under Options, one of houses, sheds",
  );
});
