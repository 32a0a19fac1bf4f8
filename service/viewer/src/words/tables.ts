/** The words that the service describes once for its API, its documents and this page; it puts them into the page. */

export interface Stage {
  name: string;
  words: string;
  /** What its progress counts. */
  unit: string;
  /** The jobs that have it. */
  of: string;
}

export interface Column {
  label: string;
  /** `%` for a share; empty for a number of things. */
  unit: string;
  digits: number;
  section: string;
  /** It is in the elevation's unit of the run. */
  isElevation: boolean;
}

interface Tables {
  /** In the order in which a job goes through them. */
  stages: Stage[];
  /** Why an object is not a building, or has no model of its own kind. */
  reasons: Record<string, string>;
  /** The columns of a building's record that the page shows. */
  columns: Record<string, Column>;
  /** Labels of the form's fields by the input that they set. */
  inputs: Record<string, string>;
  /** Further formats of the models by the words of the input `publish`. */
  formats: Record<string, string>;
  /** Endings of the files that are taken. */
  endings: { tiles: string; vectors: string };
}

const text = typeof document === "undefined" ? null : document.getElementById("words")?.textContent;
const NONE: Tables = { stages: [], reasons: {}, columns: {}, inputs: {}, formats: {}, endings: { tiles: "", vectors: "" } };

export const TABLES: Tables = text == null ? NONE : (JSON.parse(text) as Tables);
