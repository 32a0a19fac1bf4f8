import { expect, test } from "vitest";
import { jsonLines } from "../src/api/lines";

async function* cut(bytes: Uint8Array, size: number): AsyncGenerator<Uint8Array> {
  for (let at = 0; at < bytes.length; at += size) yield bytes.subarray(at, at + size);
}

async function linesOf(text: string, size: number): Promise<string[]> {
  const lines: string[] = [];
  for await (const line of jsonLines(cut(new TextEncoder().encode(text), size))) lines.push(line);
  return lines;
}

test("lines do not depend on how the bytes are cut, inside of characters either", async () => {
  const text = '{"a":"Straße"}\r\n\n\u001e{"b":"€ 𝄞"}\n{"c":3}';
  const whole = await linesOf(text, 1000);
  expect(whole).toEqual(['{"a":"Straße"}', '{"b":"€ 𝄞"}', '{"c":3}']);
  for (let size = 1; size < 12; size++) expect(await linesOf(text, size)).toEqual(whole);
});

test("an empty stream has no lines", async () => {
  expect(await linesOf("", 4)).toEqual([]);
});
