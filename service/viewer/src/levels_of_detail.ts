/** Levels of detail of the models, as Biljecki et al. (2016) number them. */

const WORDS: Record<string, string> = { "1.2": "one block", "1.3": "level parts", "2.2": "roof faces" };

/** What a model of this level is made of; empty for a level that the page does not know. */
export function levelWords(lod: string): string {
  return WORDS[lod] ?? "";
}

/** Coarse to fine. */
export function inOrder(lods: Iterable<string>): string[] {
  return [...new Set(lods)].sort((a, b) => Number(a) - Number(b));
}

/** The single levels among what the process takes: each alone, and several with commas between them. */
export function levelsOffered(sets: readonly string[]): string[] {
  return inOrder(sets.flatMap((set) => set.split(",")));
}

/** Some levels as the input `lods` of the process. */
export function lodsInput(chosen: Iterable<string>): string {
  return inOrder(chosen).join(",");
}

/** The finest of some levels that is no finer than what is asked for, of null the finest; null where there is none. */
export function levelShown(there: Iterable<string>, asked: string | null): string | null {
  const fitting = inOrder(there).filter((lod) => asked === null || Number(lod) <= Number(asked));
  return fitting[fitting.length - 1] ?? null;
}
