// Sends a file with tus-js-client: node tus_client.mjs VIEWER ENDPOINT FILE; reports events as lines of JSON.
import fs from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";

const [viewer, endpoint, file] = process.argv.slice(2);
const { Upload } = createRequire(path.join(viewer, "package.json"))("tus-js-client");
const say = (event) => console.log(JSON.stringify(event));

const upload = new Upload(fs.createReadStream(file), {
  endpoint,
  uploadSize: fs.statSync(file).size,
  metadata: { filename: path.basename(file) },
  retryDelays: Array(50).fill(100),
  onAfterResponse: (request, response) =>
    say({ method: request.getMethod(), status: response.getStatus(), offset: response.getHeader("Upload-Offset") ?? null }),
  onSuccess: ({ lastResponse }) => say({ done: lastResponse.getHeader("Content-Location") }),
  onError: (error) => say({ error: error.message, body: error.originalResponse?.getBody() ?? null }),
});
upload.start();
