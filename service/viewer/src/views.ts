/** The views beside the jobs themselves. Each is loaded when it is opened first. */

import type { Address } from "./address";
import { unreachable } from "./api";
import { el } from "./elements";
import type { Hooks } from "./job_view";
import { problemNotice } from "./notices";

/** A view that is shown. */
export interface View {
  /** Show another address of the same path: the query has changed. */
  follow(address: Address): void;
  leave(): void;
}

export type Show = (place: HTMLElement, address: Address, hooks: Hooks) => View;

const VIEWS: Record<string, () => Promise<Show>> = {
  jobs: async () => (await import("./history")).showHistory,
  changes: async () => (await import("./changes_view")).showChanges,
  schedules: async () => (await import("./schedules_view")).showSchedules,
  webhooks: async () => (await import("./webhooks_view")).showWebhooks,
};

export const hasView = (name: string): boolean => Object.hasOwn(VIEWS, name);

/** Load and show a view. */
export function showView(place: HTMLElement, address: Address, hooks: Hooks): View {
  let shown: View | null = null;
  let now = address;
  let isLeft = false;
  const load = (): void => {
    place.replaceChildren(el("p", { class: "loading" }, "Loading…"));
    VIEWS[address.name]?.().then(
      (show) => {
        if (!isLeft) shown = show(place, now, hooks);
      },
      () => {
        // the file of the view was not sent
        if (!isLeft) place.replaceChildren(el("div", { class: "card" }, problemNotice(unreachable(), load)));
      },
    );
  };
  load();
  return {
    follow: (other) => {
      now = other;
      shown?.follow(other);
    },
    leave: () => {
      isLeft = true;
      shown?.leave();
    },
  };
}
