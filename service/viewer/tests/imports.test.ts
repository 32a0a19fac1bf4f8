import { describe, expect, it } from "vitest";

const SOURCES = import.meta.glob<string>("../src/**/*.ts", { query: "?raw", import: "default", eager: true });
const IMPORT = /(?:from|import|new URL\()\s*\(?\s*"(\.[^"]+)"/g;

const folderOf = (path: string): string => path.slice(0, path.lastIndexOf("/"));

/** What a module imports, in any way, also only types and only when it is needed; styles are left out. */
function importsOf(module: string, text: string): string[] {
  const paths = [...text.matchAll(IMPORT)].map(([, path = ""]) => new URL(path, `file:///tests/${module}`).pathname);
  return paths.filter((path) => !path.endsWith(".css")).map((path) => `..${path}${path.endsWith(".ts") ? "" : ".ts"}`);
}

/** The first way found from a node back to itself; null if there is none. */
function circleIn(graph: ReadonlyMap<string, readonly string[]>): string[] | null {
  const done = new Set<string>();
  const follow = (node: string, way: readonly string[]): string[] | null => {
    if (way.includes(node)) return [...way.slice(way.indexOf(node)), node];
    if (done.has(node)) return null;
    for (const next of graph.get(node) ?? []) {
      const circle = follow(next, [...way, node]);
      if (circle !== null) return circle;
    }
    done.add(node);
    return null;
  };
  for (const node of graph.keys()) {
    const circle = follow(node, []);
    if (circle !== null) return circle;
  }
  return null;
}

describe("the imports of the page", () => {
  const imports = new Map(Object.entries(SOURCES).map(([module, text]) => [module, importsOf(module, text)]));

  it("lead to modules that exist", () => {
    const missing = [...imports].flatMap(([name, paths]) => paths.filter((path) => !imports.has(path)).map((path) => `${name}: ${path}`));
    expect(missing).toEqual([]);
    expect(imports.size).toBeGreaterThan(50);
  });

  it("have no circle between modules", () => {
    expect(circleIn(imports)?.join(" imports ")).toBeUndefined();
  });

  it("have no circle between folders", () => {
    const folders = new Map<string, string[]>();
    for (const [name, paths] of imports) {
      const folder = folderOf(name);
      const others = paths.map((path) => folderOf(path)).filter((other) => other !== folder);
      folders.set(folder, [...(folders.get(folder) ?? []), ...others]);
    }
    expect(circleIn(folders)?.join(" imports ")).toBeUndefined();
  });

  it("would show a circle", () => {
    expect(circleIn(new Map([["a", ["b"]], ["b", ["c"]], ["c", ["b"]]]))).toEqual(["b", "c", "b"]);
  });
});
