import { chunks, linesOf } from "./lines";
import { Problem, request } from "./requests";

/** One server-sent event. */
export interface ServerEvent {
  data: string;
  /** Its id; that of an event before if it has none. */
  id: string;
  /** Milliseconds that the server asks to wait before connecting again; null if it has not asked. */
  retryMs: number | null;
}

/** The events of text/event-stream (WHATWG HTML, 9.2). */
export async function* eventsOf(stream: AsyncIterable<Uint8Array>): AsyncGenerator<ServerEvent> {
  let data: string[] = [];
  let id = "";
  let retryMs: number | null = null;
  for await (const line of linesOf(stream)) {
    if (line === "") {
      if (data.length > 0) yield { data: data.join("\n"), id, retryMs };
      data = [];
    }
    const [, field, value = ""] = /^(\w+)(?:: ?(.*))?$/s.exec(line) ?? [];
    if (field === "data") data.push(value);
    else if (field === "id" && !value.includes("\0")) id = value;
    else if (field === "retry" && /^\d+$/.test(value)) retryMs = Number(value);
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
      for await (const event of eventsOf(chunks(response.body))) {
        if (event.id !== "") last = event.id;
        if (onEvent(event)) return;
        waitMs = event.retryMs ?? waitMs;
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

/** Wait; an AbortError ends it early. */
export function waited(milliseconds: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve, reject) => {
    signal.throwIfAborted();
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(new DOMException("cancelled", "AbortError"));
    });
  });
}
