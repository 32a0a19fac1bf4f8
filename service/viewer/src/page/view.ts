/** What the page and its views know of each other. */

import type { Problem } from "../api/requests";
import type { Address } from "./address";

/** The calls of a view to the page. */
export interface Hooks {
  /** The list no longer shows the job's state. */
  onChange: () => void;
  onProblem: (problem: Problem) => void;
}

/** A view that is shown. */
export interface View {
  /** Show another address of the same path: the query has changed. */
  follow(address: Address): void;
  leave(): void;
}

export type Show = (place: HTMLElement, address: Address, hooks: Hooks) => View;
