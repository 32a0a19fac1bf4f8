import { chunks } from "./json_lines";
import { Problem, request } from "./requests";

/** One server-sent event. */
export interface ServerEvent {
  event: string;
  data: string;
  id: string;
}

/** Reads text/event-stream (WHATWG HTML, 9.2) in pieces of any size. */
export class EventStreamReader {
  private rest = "";
  private event = "";
  private id = "";
  private data: string[] = [];
  /** Milliseconds that the server asks to wait before connecting again. */
  retryMs: number | null = null;

  *read(text: string): Generator<ServerEvent> {
    const lines = (this.rest + text).split(/\r\n|\n|\r(?!$)/);
    this.rest = lines.pop() ?? "";
    for (const line of lines) {
      const event = this.line(line);
      if (event !== null) yield event;
    }
  }

  private line(line: string): ServerEvent | null {
    if (line === "") {
      const event = { event: this.event || "message", data: this.data.join("\n"), id: this.id };
      const empty = this.data.length === 0;
      this.event = "";
      this.data = [];
      return empty ? null : event;
    }
    const colon = line.indexOf(":");
    const field = colon < 0 ? line : line.slice(0, colon);
    const value = colon < 0 ? "" : line.slice(colon + 1).replace(/^ /, "");
    if (field === "event") this.event = value;
    else if (field === "data") this.data.push(value);
    else if (field === "id" && !value.includes("\0")) this.id = value;
    else if (field === "retry" && /^\d+$/.test(value)) this.retryMs = Number(value);
    return null;
  }
}

/**
 * Follows a stream of events until `onEvent` answers that it is over; reconnects if it breaks.
 *
 * EventSource would do the same, but sends no Authorization header.
 *
 * @throws Problem if the service refuses the stream permanently, AbortError if cancelled.
 */
export async function follow(
  path: string,
  onEvent: (event: ServerEvent) => boolean,
  onConnection: (connected: boolean) => void,
  signal: AbortSignal,
): Promise<void> {
  let last = "";
  let waitMs = 1000;
  for (;;) {
    try {
      const headers: Record<string, string> = { Accept: "text/event-stream" };
      if (last !== "") headers["Last-Event-ID"] = last;
      const response = await request(path, { headers, signal });
      if (response.status === 204) return; // the job is over and all events are known
      onConnection(true);
      waitMs = 1000;
      const reader = new EventStreamReader();
      const decoder = new TextDecoder();
      if (response.body === null) throw new TypeError("the answer has no body");
      for await (const bytes of chunks(response.body)) {
        for (const event of reader.read(decoder.decode(bytes, { stream: true }))) {
          if (event.id !== "") last = event.id;
          if (onEvent(event)) return;
        }
        waitMs = reader.retryMs ?? waitMs;
      }
    } catch (error) {
      if (signal.aborted) throw error;
      if (error instanceof Problem && error.status >= 400 && error.status < 500 && error.status !== 429) throw error;
    }
    onConnection(false);
    await waited(waitMs, signal);
    waitMs = Math.min(2 * waitMs, 10_000);
  }
}

function waited(milliseconds: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(new DOMException("cancelled", "AbortError"));
    });
  });
}
