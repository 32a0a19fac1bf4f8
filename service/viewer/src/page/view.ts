/** What the page and its views know of each other. */

import type { Address } from "./address";

/** The event of the document when a job was made, changed or removed. */
export const JOBS_CHANGED = "jobs-changed";

export const jobsChanged = (): void => void document.dispatchEvent(new Event(JOBS_CHANGED));

/** A view that is shown. */
export interface View {
  /** Show another address of the same path: the query has changed. */
  follow(address: Address): void;
  leave(): void;
}

/** Shows what an address names, once the view follows it. */
export type Show = (place: HTMLElement, address: Address) => View;
