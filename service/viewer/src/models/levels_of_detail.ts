/** Levels of detail of the models, numbered as in Biljecki et al. (2016). */

const WORDS: Record<string, string> = {
  "1.2": "one block",
  "1.3": "level parts",
  "2.0": "main roof",
  "2.2": "roof faces",
  "2.3": "roof faces with overhangs",
};

/** The parts of a model of this level; empty for an unknown level. */
export function levelWords(lod: string): string {
  return WORDS[lod] ?? "";
}

/** Coarse to fine. */
export function inOrder(lods: Iterable<string>): string[] {
  return [...new Set(lods)].sort((a, b) => Number(a) - Number(b));
}

/** The single levels among the values of the process: each alone, or several with commas between them. */
export function levelsOffered(sets: readonly string[]): string[] {
  return inOrder(sets.flatMap((set) => set.split(",")));
}

/** Some levels as the input `lods` of the process. */
export function lodsInput(chosen: Iterable<string>): string {
  return inOrder(chosen).join(",");
}

/** The finest level up to the wanted one, or the finest of all for null; null if there is none. */
export function levelShown(there: Iterable<string>, asked: string | null): string | null {
  const fitting = inOrder(there).filter((lod) => asked === null || Number(lod) <= Number(asked));
  return fitting[fitting.length - 1] ?? null;
}
