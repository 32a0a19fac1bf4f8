/** Settings of a job as a flat list of names and values, and back. */

import type { SettingSchema } from "../api/types";
import { textOf } from "../page/form_fields";

/** Settings by name: `candidates.min_area_m2`, or `tile_size_m` for a general one. */
export type Flat = Map<string, unknown>;

/** The settings of nested tables. */
export function flat(tables: Readonly<Record<string, unknown>>): Flat {
  const isTable = (one: unknown): boolean => typeof one === "object" && one !== null && !Array.isArray(one);
  return flattened(tables, (one) => (isTable(one) ? (one as Record<string, unknown>) : undefined));
}

/** All settings that a process knows, by the same names. */
export const known = ({ properties = {} }: SettingSchema): Map<string, SettingSchema> => flattened(properties, (one) => one.properties);

function flattened<T>(tables: Readonly<Record<string, T>>, tableOf: (one: T) => Record<string, T> | undefined): Map<string, T> {
  const found = Object.entries(tables).flatMap(([name, one]): [string, T][] => {
    const table = tableOf(one);
    return table === undefined ? [[name, one]] : Object.entries(table).map(([key, inner]) => [`${name}.${key}`, inner]);
  });
  return new Map(found);
}

/** What leads from one list to another, as nested tables: null takes a setting away. */
export function changes(before: Flat, after: Flat): Record<string, unknown> {
  const found: Record<string, unknown> = {};
  for (const name of new Set([...before.keys(), ...after.keys()])) {
    const value = after.has(name) ? after.get(name) : null;
    if (JSON.stringify(value) === JSON.stringify(before.has(name) ? before.get(name) : null)) continue;
    const [table = "", key] = name.split(/\.(.*)/s);
    if (key === undefined) found[table] = value;
    else found[table] = { ...(found[table] as Record<string, unknown> | undefined), [key]: value };
  }
  return found;
}

/** Unit, range and default of a setting in one sentence. */
export function rangeWords({ default: usual, minimum, maximum, enum: words }: SettingSchema): string {
  const least = minimum === undefined ? "" : `at least ${minimum}`;
  const most = maximum === undefined ? "" : `at most ${maximum}`;
  const parts = [words?.join(", ") ?? "", least, most, usual === undefined || usual === "" ? "" : `usually ${textOf(usual)}`];
  return parts.filter((part) => part !== "").join("; ");
}
