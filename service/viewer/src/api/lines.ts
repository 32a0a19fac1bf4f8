/** The lines of a stream of UTF-8 text, one after another, for chunks of any size. The last one may lack its end. */
export async function* linesOf(stream: AsyncIterable<Uint8Array>): AsyncGenerator<string> {
  const decoder = new TextDecoder();
  let rest = "";
  for await (const bytes of stream) {
    const lines = (rest + decoder.decode(bytes, { stream: true })).split(/\r\n|\n|\r(?!$)/);
    rest = lines.pop() ?? "";
    yield* lines;
  }
  rest += decoder.decode();
  if (rest !== "") yield rest;
}

/** The same without empty lines and the record separators of RFC 8142. */
export async function* jsonLines(stream: AsyncIterable<Uint8Array>): AsyncGenerator<string> {
  for await (const line of linesOf(stream)) {
    const cleaned = line.replaceAll("\u001e", "").trim();
    if (cleaned !== "") yield cleaned;
  }
}

/** The chunks of a response's body; not every browser lets one iterate a ReadableStream. */
export async function* chunks(body: ReadableStream<Uint8Array> | null): AsyncGenerator<Uint8Array> {
  if (body === null) throw new TypeError("the answer has no body");
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
