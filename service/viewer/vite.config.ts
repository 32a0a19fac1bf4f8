import { defineConfig } from "vite";

const SERVICE = "http://127.0.0.1:8000"; // what `gablework serve` listens on; only for `npm run dev`

export default defineConfig(({ command }) => ({
  base: command === "build" ? "/viewer/" : "/",
  build: {
    target: "es2022",
    // the Content-Security-Policy of the service allows no data: URLs
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 800,
  },
  worker: { format: "es" as const },
  experimental: {
    // the page is served at the service's root, its files below viewer/: relative, so that a path prefix of a proxy does no harm
    renderBuiltUrl: (filename, { hostType }) =>
      hostType === "html" ? `viewer/${filename}` : { relative: true },
  },
  server: {
    proxy: Object.fromEntries(
      ["/processes", "/jobs", "/uploads", "/conformance", "/openapi.json", "/docs"].map((path) => [path, SERVICE]),
    ),
  },
}));
