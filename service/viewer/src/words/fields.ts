/** The words of the service for readers of the page: labels of fields in place of inputs of a process. */

import { TABLES } from "../words/tables";

/** A message that names fields in place of inputs, and no settings of the operator. */
export function inFields(message: string): string {
  return message
    .replace(/\b(give|with)?( ?)the input (\w+)/gi, (whole: string, verb: string | undefined, space: string, name: string) => {
      if (!Object.hasOwn(TABLES.inputs, name)) return whole;
      const field = `“${TABLES.inputs[name]}” under Options`;
      if (verb === undefined) return `${space}${field}`;
      return verb === "with" ? `in ${field}` : `${verb === "Give" ? "Set" : "set"} ${field}`;
    })
    .replace(/,? or add \S+ to GABLEWORK_\w+/g, "")
    .replace(/,? or raise GABLEWORK_\w+/g, ", or ask the operator of this service to raise the limit");
}

/** Why an object is not a building, or has no model of its own kind, in plain words. */
export function reasonWords(reason: string): string {
  return TABLES.reasons[reason] ?? reason.replaceAll("_", " ");
}

/** A text that begins with a capital letter. */
export function capital(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}
