import { expect, test } from "vitest";
import { EventStreamReader, type ServerEvent } from "../src/api/event_stream";

const STREAM = ': hello\nretry: 1500\n\nid: 1\nevent: stage\ndata: {"a":1}\n\ndata: two\ndata: lines\nid: 2\n\nevent: idle\n\ndata:last\r\n\r\n';

function eventsOf(text: string, size: number): ServerEvent[] {
  const reader = new EventStreamReader();
  const events: ServerEvent[] = [];
  for (let at = 0; at < text.length; at += size) events.push(...reader.read(text.slice(at, at + size)));
  return events;
}

test("events do not depend on how the stream is cut", () => {
  const whole = eventsOf(STREAM, 10_000);
  expect(whole).toEqual([
    { event: "stage", data: '{"a":1}', id: "1" },
    { event: "message", data: "two\nlines", id: "2" },
    { event: "message", data: "last", id: "2" },
  ]);
  for (let size = 1; size < 20; size++) expect(eventsOf(STREAM, size)).toEqual(whole);
});

test("the server's wish for a pause is kept", () => {
  const reader = new EventStreamReader();
  expect([...reader.read(STREAM)]).toHaveLength(3);
  expect(reader.retryMs).toBe(1500);
});

test("an unfinished event is not reported", () => {
  expect(eventsOf("data: half\n", 100)).toEqual([]);
});
