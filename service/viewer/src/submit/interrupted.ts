/** Files that were not sent to their end, as this browser remembers them. */

import { defaultOptions, type UrlStorage } from "tus-js-client";
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

/** The same for the same file on the same service, as far as a page can know. */
export const fingerprint = (file: File): string => [serviceUrl(""), file.name, file.size, file.lastModified].join("|");

/** The beginning of the keys under which the library stores uploads of such a fingerprint. */
export const keyOf = (mark: string): string => `tus::${mark}`;

const stored = defaultOptions.urlStorage;

/** The storage of the library, which would also forget an upload for which a key is missing, and fail where it is full. */
export const memory: UrlStorage = {
  findAllUploads: () => stored.findAllUploads(),
  findUploadsByFingerprint: (mark) => stored.findUploadsByFingerprint(mark),
  removeUpload: async () => undefined,
  addUpload: async (mark, upload) => {
    try {
      return await stored.addUpload(mark, upload);
    } catch {
      return ""; // the upload itself goes on
    }
  },
};

/** Forget the uploads of a file here. */
export async function drop(mark: string): Promise<void> {
  for (const { urlStorageKey } of await stored.findUploadsByFingerprint(mark)) await stored.removeUpload(urlStorageKey);
}

/** The path of an upload on this service; its stored address may be that of a proxy. */
export const placeOf = (url: string): string => `uploads/tus/${url.slice(url.lastIndexOf("/") + 1)}`;

const asking = (method: string, url: string): Promise<Response> =>
  fetch(serviceUrl(placeOf(url)), { method, cache: "no-store", headers: { "Tus-Resumable": "1.0.0", ...authorization() } });

/** The uploads that can be continued; those that the service has no longer are forgotten. */
export async function interrupted(): Promise<Interrupted[]> {
  const found: Interrupted[] = [];
  for (const { urlStorageKey: key, metadata, size, uploadUrl: url } of await stored.findAllUploads()) {
    // other pages of this host may use the same library
    if (url === null || !key.startsWith(keyOf(serviceUrl("")))) continue;
    const answer = await asking("HEAD", url).catch(() => null);
    if (answer?.status === 404) await stored.removeUpload(key);
    const offset = Number(answer?.headers.get("Upload-Offset") ?? Number.NaN);
    if (answer?.ok === true && offset > 0) found.push({ key, url, name: metadata["filename"] ?? "", size: size ?? 0, offset });
  }
  return found;
}

/** Remove an upload here and on the service. */
export async function forget({ key, url }: Interrupted): Promise<void> {
  await asking("DELETE", url).catch(() => null);
  await stored.removeUpload(key);
}
