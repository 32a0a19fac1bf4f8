/** The views beside the jobs themselves. Each is loaded when it is opened first. */

import { unreachable } from "./api/requests";
import type { Address } from "./page/address";
import { el } from "./page/elements";
import { problemNotice } from "./page/notices";
import type { Show, View } from "./page/view";

const VIEWS: Record<string, () => Promise<Show>> = {
  jobs: async () => (await import("./jobs/history")).showHistory,
  changes: async () => (await import("./changes/changes_view")).showChanges,
  schedules: async () => (await import("./service/schedules_view")).showSchedules,
  webhooks: async () => (await import("./service/webhooks_view")).showWebhooks,
};

export const hasView = (name: string): boolean => Object.hasOwn(VIEWS, name);

/** Load and show a view. */
export function showView(place: HTMLElement, address: Address): View {
  let shown: View | null = null;
  let now = address;
  let isLeft = false;
  const load = (): void => {
    place.replaceChildren(el("p", { class: "loading" }, "Loading…"));
    VIEWS[address.name]?.().then(
      (show) => {
        if (isLeft) return;
        shown = show(place, now);
        shown.follow(now);
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
