/**
 * The lines of a stream of UTF-8 text, one after another, for chunks of any size.
 *
 * Empty lines and the record separators of RFC 8142 are dropped.
 */
export async function* jsonLines(stream: AsyncIterable<Uint8Array>): AsyncGenerator<string> {
  const decoder = new TextDecoder();
  let rest = "";
  for await (const bytes of stream) {
    const parts = (rest + decoder.decode(bytes, { stream: true })).split("\n");
    rest = parts.pop() ?? "";
    for (const part of parts) {
      const line = cleaned(part);
      if (line !== "") yield line;
    }
  }
  const last = cleaned(rest + decoder.decode());
  if (last !== "") yield last;
}

function cleaned(line: string): string {
  return line.replaceAll("\u001e", "").trim();
}

/** The chunks of a response's body; not every browser lets one iterate a ReadableStream. */
export async function* chunks(body: ReadableStream<Uint8Array>): AsyncGenerator<Uint8Array> {
  const reader = body.getReader();
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      yield value;
    }
  } finally {
    reader.releaseLock();
  }
}
