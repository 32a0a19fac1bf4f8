/** Large files that were not sent to their end, as this browser remembers them. */

import { authorization, serviceUrl } from "../api/requests";

const PREFIX = "gablework.upload.";

/** What is stored about an upload; the names are those of tus-js-client. */
export interface Remembered {
  size: number | null;
  metadata: Record<string, string>;
  creationTime: string;
  urlStorageKey: string;
  uploadUrl: string | null;
  parallelUploadUrls: string[] | null;
}

/** An upload that waits for its file. */
export interface Interrupted {
  key: string;
  name: string;
  size: number;
  /** Bytes that the service has. */
  offset: number;
}

/** The same for the same file on the same service, as far as a page can know. */
export const fingerprint = (file: File): string => [file.name, file.size, file.lastModified, serviceUrl("")].join("|");

export const keyOf = (mark: string): string => `${PREFIX}${mark}`;

/** The storage of tus-js-client, one entry per file. A browser may refuse to store anything: then nothing is remembered. */
export const memory = {
  findAllUploads: async (): Promise<Remembered[]> => {
    try {
      return Object.keys(localStorage).flatMap((key) => (key.startsWith(PREFIX) ? read(key) : []));
    } catch {
      return [];
    }
  },
  findUploadsByFingerprint: async (mark: string): Promise<Remembered[]> => read(keyOf(mark)),
  removeUpload: async (key: string): Promise<void> => {
    try {
      localStorage.removeItem(key);
    } catch {
      return;
    }
  },
  addUpload: async (mark: string, upload: Remembered): Promise<string> => {
    const key = keyOf(mark);
    try {
      localStorage.setItem(key, JSON.stringify(upload));
    } catch {
      // the upload itself goes on
      return key;
    }
    return key;
  },
};

function read(key: string): Remembered[] {
  try {
    const text = localStorage.getItem(key);
    return text === null ? [] : [{ ...(JSON.parse(text) as Remembered), urlStorageKey: key }];
  } catch {
    return [];
  }
}

/** The path of an upload on this service; its stored address may be that of a proxy. */
export const placeOf = (url: string): string => `uploads/tus/${url.slice(url.lastIndexOf("/") + 1)}`;

const asking = (method: string, url: string): Promise<Response> =>
  fetch(serviceUrl(placeOf(url)), { method, cache: "no-store", headers: { "Tus-Resumable": "1.0.0", ...authorization() } });

/** The uploads that can be continued; those that the service has no longer are forgotten. */
export async function interrupted(): Promise<Interrupted[]> {
  const found: Interrupted[] = [];
  for (const { urlStorageKey: key, metadata, size, uploadUrl } of await memory.findAllUploads()) {
    const answer = uploadUrl === null ? null : await asking("HEAD", uploadUrl).catch(() => null);
    if (answer?.status === 404) await memory.removeUpload(key);
    const offset = Number(answer?.headers.get("Upload-Offset") ?? Number.NaN);
    if (answer?.ok === true && offset > 0) found.push({ key, name: metadata["filename"] ?? "", size: size ?? 0, offset });
  }
  return found;
}

/** Remove an upload here and on the service. */
export async function forget(key: string): Promise<void> {
  for (const { uploadUrl } of read(key)) if (uploadUrl !== null) await asking("DELETE", uploadUrl).catch(() => null);
  await memory.removeUpload(key);
}
