import { defineConfig } from "vitest/config";

export default defineConfig({
  test: {
    // the service puts the words into the page, which tests do not have
    alias: [{ find: /.*\/words\/tables$/, replacement: new URL("tests/tables.ts", import.meta.url).pathname }],
  },
});
