import { TABLES } from "../words/tables";

/** Why an object is not a building, or has no model of its own kind, in plain words. */
export function reasonWords(reason: string): string {
  return TABLES.reasons[reason] ?? reason.replaceAll("_", " ");
}
