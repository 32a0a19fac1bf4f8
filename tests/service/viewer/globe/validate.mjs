// Prints the Khronos validator's report on each file: errors, and the codes of all messages.
import { readFile } from "node:fs/promises";
import { validateBytes } from "gltf-validator";

const reports = {};
for (const path of process.argv.slice(2)) {
  const { issues } = await validateBytes(new Uint8Array(await readFile(path)), { maxIssues: 0 });
  const codes = [...new Set(issues.messages.map(({ code }) => code))].sort();
  reports[path] = { errors: issues.numErrors, warnings: issues.numWarnings, codes };
}
console.log(JSON.stringify(reports));
