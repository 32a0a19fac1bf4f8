// @vitest-environment happy-dom
import { describe, expect, test } from "vitest";
import { flatOutlines } from "../src/models/failed_footprints";
import { readRejected } from "../src/models/rejected_objects";
import { rejectedRecord } from "../src/results/record";

/** Parquet written by pyarrow: two objects, one without a confidence. */
const TABLE =
  "UEFSMRUAFSwVLCwVBBUAFQYVBhwAAAACAAAABAEEAAAAc2hlZAQAAAB5YXJkFQAVPBU8LBUEFQAVBhUGHAAAAAIAAAAEAQkAAAB0b29fc21hbG" +
  "wHAAAAdG9vX2xvdxUAFRwVHCwVBBUAFQYVBhwAAAACAAAAAwEAAAAAAADQPxUEGUw1ABgGc2NoZW1hFQYAFQwlAhgJb2JqZWN0X2lkJQBMHAAA" +
  "ABUMJQIYBnJlYXNvbiUATBwAAAAVCiUCGBRkZXRlY3Rpb25fY29uZmlkZW5jZQAWBBkcGTwmABwVDBklBgAZGAlvYmplY3RfaWQVABYEFlIWUi" +
  "YISRwVABUAFQIAPBYQGQYZJgAEAAAAJgAcFQwZJQYAGRgGcmVhc29uFQAWBBZiFmImWkkcFQAVABUCADwWIBkGGSYABAAAACYAHBUKGSUGABkY" +
  "FGRldGVjdGlvbl9jb25maWRlbmNlFQAWBBZCFkImvAFJHBUAFQAVAgA8KQYZJgICAAAAFvYBFgQmCBb2AQAoIHBhcnF1ZXQtY3BwLWFycm93IH" +
  "ZlcnNpb24gMjYuMC4xGTwcAAAcAAAcAAAANwEAAFBBUjE=";
/** The same of an older version, with an area and without confidences. */
const OLD =
  "UEFSMRUAFRwVHCwVAhUAFQYVBhwAAAACAAAAAgEEAAAAc2hlZBUAFSYVJiwVAhUAFQYVBhwAAAACAAAAAgEJAAAAdG9vX3NtYWxsFQAVHBUcLB" +
  "UCFQAVBhUGHAAAAAIAAAACAQAAAAAAACNAFQQZTDUAGAZzY2hlbWEVBgAVDCUCGAlvYmplY3RfaWQlAEwcAAAAFQwlAhgGcmVhc29uJQBMHAAA" +
  "ABUKJQIYB2FyZWFfbTIAFgIZHBk8JgAcFQwZJQYAGRgJb2JqZWN0X2lkFQAWAhZCFkImCEkcFQAVABUCADwWCBkGGSYAAgAAACYAHBUMGSUGAB" +
  "kYBnJlYXNvbhUAFgIWTBZMJkpJHBUAFQAVAgA8FhIZBhkmAAIAAAAmABwVChklBgAZGAdhcmVhX20yFQAWAhZCFkImlgFJHBUAFQAVAgA8KQYZ" +
  "JgACAAAAFtABFgImCBbQAQAoIHBhcnF1ZXQtY3BwLWFycm93IHZlcnNpb24gMjYuMC4xGTwcAAAcAAAcAAAAHQEAAFBBUjE=";

const bytes = (text: string): ArrayBuffer => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;

/** What the record of each object shows, as text. */
async function shown(table: string): Promise<string[]> {
  const frame = { origin: [0, 0, 0] as const, horizontalUnitM: 1, verticalUnitM: 1 };
  const { listed } = flatOutlines(await readRejected(bytes(table)), "rejected", frame, () => 0);
  return listed.map((object) => rejectedRecord(object).map(({ textContent }) => textContent).join(" "));
}

describe("objects that were left out", () => {
  test("show the confidence that they are buildings, where it is known", async () => {
    const [shed, yard] = await shown(TABLE);
    expect(shed).toContain("Confidence that it is a building25.0\u202f%");
    expect(yard).toContain("Confidence that it is a building–");
  });

  test("of an older version are read without it", async () => {
    const [shed] = await shown(OLD);
    expect(shed).toContain("Area10\u202fm²");
    expect(shed).toContain("Confidence that it is a building–");
  });
});
