import { vi } from "vitest";

type Answer = { status?: number; body?: unknown };

/** An answer that a test gives when it wants to. */
export interface Held {
  give(answer: Answer): void;
}

/**
 * A service in place of the network: it answers `METHOD path`, the path below the page's folder and with its query.
 *
 * Without an answer to a request it says 404.
 */
export class FakeService {
  /** What was asked, in order. */
  readonly asked: string[] = [];
  private readonly answers = new Map<string, Promise<Answer>>();

  constructor() {
    vi.stubGlobal("fetch", (url: string, { method = "GET", signal }: RequestInit = {}) => this.answer(method, url, signal ?? null));
  }

  /** Answer from now on. */
  on(request: string, body: unknown, status = 200): void {
    this.answers.set(request, Promise.resolve({ status, body }));
  }

  /** Let requests wait from now on. */
  hold(request: string): Held {
    let give: (answer: Answer) => void = () => undefined;
    this.answers.set(request, new Promise((resolve) => (give = resolve)));
    return { give: (answer) => give(answer) };
  }

  /** How often it was asked. */
  count(request: string): number {
    return this.asked.filter((one) => one === request).length;
  }

  private answer(method: string, url: string, signal: AbortSignal | null): Promise<Response> {
    const request = `${method} ${url.slice(new URL(".", document.baseURI).href.length)}`;
    this.asked.push(request);
    return new Promise((resolve, reject) => {
      const cancelled = (): void => reject(new DOMException("cancelled", "AbortError"));
      if (signal?.aborted === true) cancelled();
      signal?.addEventListener("abort", cancelled);
      void (this.answers.get(request) ?? Promise.resolve({ status: 404, body: { title: `No answer to ${request}` } })).then(
        ({ status = 200, body }) => resolve(new Response(JSON.stringify(body ?? {}), { status })),
      );
    });
  }
}

/** Wait until all has happened that waits for no held answer: parts of the page that are loaded, too. */
export async function settled(): Promise<void> {
  for (let turn = 0; turn < 5; turn++) {
    await vi.dynamicImportSettled();
    await new Promise((done) => setTimeout(done));
  }
}

/** Click on a button by its words. */
export function press(words: string, within: ParentNode = document): void {
  const found = [...within.querySelectorAll("button")].filter(({ textContent }) => textContent === words);
  if (found.length !== 1) throw new Error(`${found.length} buttons say ${words}`);
  found[0].click();
}
