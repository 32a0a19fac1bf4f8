import { expect, test } from "vitest";
import { eventsOf, waited, type ServerEvent } from "../src/api/event_stream";

const STREAM = ': hello\nretry: 1500\n\nid: 1\nevent: stage\ndata: {"a":1}\n\ndata: two\ndata: lines\nid: 2\n\nevent: idle\n\ndata:last\r\n\r\n';

async function* cut(bytes: Uint8Array, size: number): AsyncGenerator<Uint8Array> {
  for (let at = 0; at < bytes.length; at += size) yield bytes.subarray(at, at + size);
}

async function read(text: string, size: number): Promise<ServerEvent[]> {
  const events: ServerEvent[] = [];
  for await (const event of eventsOf(cut(new TextEncoder().encode(text), size))) events.push(event);
  return events;
}

test("events do not depend on how the stream is cut, and the server's wish for a pause is kept", async () => {
  const whole = await read(STREAM, 10_000);
  expect(whole).toEqual([
    { data: '{"a":1}', id: "1", retryMs: 1500 },
    { data: "two\nlines", id: "2", retryMs: 1500 },
    { data: "last", id: "2", retryMs: 1500 },
  ]);
  for (let size = 1; size < 20; size++) expect(await read(STREAM, size)).toEqual(whole);
});

test("an unfinished event is not reported", async () => {
  expect(await read("data: half\n", 100)).toEqual([]);
});

test("nothing waits that was called off, before or meanwhile", async () => {
  const calledOff = new AbortController();
  const waiting = waited(60_000, calledOff.signal);
  calledOff.abort();
  await expect(waiting).rejects.toThrow("cancelled");
  await expect(waited(60_000, calledOff.signal)).rejects.toThrow();
  await waited(1, new AbortController().signal);
});
