/** Numbers for people: thin groups, few digits, units with a narrow space. */

const NARROW = "\u202f";

export function count(value: number): string {
  return measure(value, 0);
}

/** `1 building`, `2 buildings`. */
export function counted(value: number, noun: string): string {
  return `${count(value)} ${noun}${value === 1 ? "" : "s"}`;
}

export function measure(value: unknown, digits: number, unit = ""): string {
  if (typeof value !== "number" || !Number.isFinite(value)) return "–";
  const places = { minimumFractionDigits: digits, maximumFractionDigits: digits, signDisplay: "negative" } as const;
  const text = value.toLocaleString("en", places).replaceAll(",", NARROW).replace("-", "−");
  return unit === "" ? text : `${text}${NARROW}${unit}`;
}

export function bytes(value: number): string {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let power = 0;
  let rest = value;
  while (rest >= 1000 && power < units.length - 1) {
    rest /= 1000;
    power += 1;
  }
  return `${rest.toFixed(power === 0 || rest >= 100 ? 0 : 1)}${NARROW}${units[power]}`;
}

/** `12 s`, `3 min 20 s`, `2 h 5 min`. */
export function duration(seconds: number): string {
  const s = Math.max(0, Math.round(seconds));
  if (s < 60) return `${s}${NARROW}s`;
  if (s < 3600) return `${Math.floor(s / 60)}${NARROW}min ${s % 60}${NARROW}s`;
  return `${Math.floor(s / 3600)}${NARROW}h ${Math.floor((s % 3600) / 60)}${NARROW}min`;
}

/** `just now`, `5 min ago`, `3 h ago`, else the date. */
export function ago(time: string): string {
  const then = new Date(time);
  const seconds = (Date.now() - then.getTime()) / 1000;
  if (seconds < 60) return "just now";
  if (seconds < 3600) return `${Math.floor(seconds / 60)}${NARROW}min ago`;
  if (seconds < 86_400) return `${Math.floor(seconds / 3600)}${NARROW}h ago`;
  return then.toLocaleDateString(undefined, { day: "numeric", month: "short", year: "numeric" });
}

/** A place on Earth, latitude first; null if there is none. */
export function placeWords(place: unknown): string | null {
  const { longitude, latitude } = (place ?? {}) as { longitude?: unknown; latitude?: unknown };
  if (typeof longitude !== "number" || typeof latitude !== "number") return null;
  const degrees = (value: number, signs: string): string => `${Math.abs(value).toFixed(2)}°\u202f${signs[value < 0 ? 1 : 0]}`;
  return `${degrees(latitude, "NS")}, ${degrees(longitude, "EW")}`;
}
