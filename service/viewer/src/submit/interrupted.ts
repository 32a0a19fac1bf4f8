/** Files that were not sent to their end, as this browser remembers them. */

import { authorization, serviceUrl } from "../api/requests";

/** An upload that waits for its file. */
export interface Interrupted {
  key: string;
  url: string;
  name: string;
  size: number;
  /** Bytes that the service has. */
  offset: number;
}

/** The beginning of all keys: other pages of this host may use the same storage. */
const prefix = (): string => `upload|${serviceUrl("")}|`;

/** The key of a file's upload: the same for the same file, as far as a page can know. */
export const keyOf = ({ name, size, lastModified }: File): string => prefix() + [name, size, lastModified].join("|");

/** Keep where a file is sent to. */
export function remember(file: File, url: string): void {
  try {
    localStorage.setItem(keyOf(file), JSON.stringify({ url, name: file.name, size: file.size }));
  } catch {
    // the storage is full: the upload itself goes on
  }
}

/** Where an upload was sent to; null if that is not known. */
export function kept(key: string): Pick<Interrupted, "url" | "name" | "size"> | null {
  return JSON.parse(localStorage.getItem(key) ?? "null") as ReturnType<typeof kept>;
}

export const drop = (key: string): void => localStorage.removeItem(key);

/** The path of an upload on this service; its stored address may be that of a proxy. */
export const placeOf = (url: string): string => `uploads/tus/${url.slice(url.lastIndexOf("/") + 1)}`;

const asking = (method: string, url: string): Promise<Response> =>
  fetch(serviceUrl(placeOf(url)), { method, cache: "no-store", headers: { "Tus-Resumable": "1.0.0", ...authorization() } });

/** The uploads that can be continued; those that the service has no longer are forgotten. */
export async function interrupted(): Promise<Interrupted[]> {
  const found: Interrupted[] = [];
  for (const key of Object.keys(localStorage).filter((name) => name.startsWith(prefix()))) {
    const upload = kept(key);
    if (upload === null) continue;
    const answer = await asking("HEAD", upload.url).catch(() => null);
    if (answer?.status === 404) drop(key);
    const offset = Number(answer?.headers.get("Upload-Offset") ?? Number.NaN);
    if (answer?.ok === true && offset > 0) found.push({ key, ...upload, offset });
  }
  return found;
}

/** Remove an upload here and on the service. */
export async function forget({ key, url }: Interrupted): Promise<void> {
  await asking("DELETE", url).catch(() => null);
  drop(key);
}
