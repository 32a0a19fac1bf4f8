import { defineConfig } from "vite";

const SERVICE = "http://127.0.0.1:8000"; // the address of `gablework serve`; only for `npm run dev`

/** The words that the service puts into the page (`src/words/tables.ts`); a build leaves them to the service. */
const words = {
  name: "words",
  apply: "serve" as const,
  transformIndexHtml: async (html: string): Promise<string> => {
    const page = await (await fetch(`${SERVICE}/?f=html`)).text();
    return html.replace("</head>", `${/<script type="application\/json" id="words">.*?<\/script>/.exec(page)?.[0] ?? ""}</head>`);
  },
};

export default defineConfig(({ command }) => ({
  plugins: [words],
  base: command === "build" ? "/viewer/" : "/",
  build: {
    target: "es2022",
    // the Content-Security-Policy of the service allows no data: URLs
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 800,
    // the licences of the packages in the bundle ask for it
    license: { fileName: "third_party_licenses.md" },
  },
  worker: { format: "es" as const },
  experimental: {
    // the page is served at the service's root, its files below viewer/: relative paths work with the path prefix of a proxy
    renderBuiltUrl: (filename, { hostType }) =>
      hostType === "html" ? `viewer/${filename}` : { relative: true },
  },
  server: {
    proxy: Object.fromEntries(
      ["/processes", "/jobs", "/uploads", "/conformance", "/openapi.json", "/docs"].map((path) => [path, SERVICE]),
    ),
  },
}));
