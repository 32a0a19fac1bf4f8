/** One message of the log: its attempts, its body, and a way to send it again. */

import { getJson, request } from "../api/requests";
import type { Delivery } from "../api/types";
import { hashOf } from "../page/address";
import { button, el } from "../page/elements";
import { announce, report } from "../page/notices";
import { backLink, rawText } from "../page/sheet";
import { chip, facts, table, type Column } from "../page/tables";
import { WatchedPage } from "../page/watched_page";
import { count } from "../words/numbers";

const REFRESH_MS = 2000;

export const DELIVERY_WORDS: Record<string, string> = {
  waiting: "waiting",
  delivered: "delivered",
  failed: "failed",
  gone: "refused for good",
  dropped: "dropped",
};

export const deliveryChip = ({ state }: Delivery): HTMLElement => chip(state, DELIVERY_WORDS[state]);

/** What to do about a message that did not arrive. */
export const DELIVERY_REMEDIES: Record<string, string> = {
  failed: "Mend the receiver, then send the message again.",
  gone: "The receiver answered that it wants no more messages. If that was a mistake, choose “Send what it missed” for the webhook.",
  dropped: "It was no longer needed. You can still send it again.",
};

/** The body as it reads best; as it was sent if it is not JSON. */
export function bodyText(body: string): string {
  try {
    return JSON.stringify(JSON.parse(body), null, 2);
  } catch {
    return body;
  }
}

export class DeliveryView extends WatchedPage<Delivery> {
  private readonly path: string;
  /** Says why it was not sent again. */
  private readonly refusal = el("div");

  constructor(place: HTMLElement, id: string) {
    super(place, "Message", backLink("#/webhooks", "All messages"), REFRESH_MS);
    this.path = `webhooks/deliveries/${encodeURIComponent(id)}`;
  }

  protected get(signal: AbortSignal): Promise<Delivery> {
    return getJson<Delivery>(this.path, { signal });
  }

  protected mayChange({ state }: Delivery): boolean {
    return state === "waiting";
  }

  private async replay(): Promise<void> {
    this.refusal.replaceChildren();
    try {
      await request(`${this.path}/replay`, { method: "POST" });
    } catch (error) {
      report(this.refusal, error);
      return;
    }
    announce("The message is sent again.");
    await this.load();
  }

  protected parts(found: Delivery, isFirst: boolean): [HTMLElement, ...HTMLElement[]] {
    const { state, nextAttempt, finished, body } = found;
    if (!isFirst) announce(`The message is ${DELIVERY_WORDS[state] ?? state}.`);
    const isUnderWay = state === "waiting" && found.attemptCount === 0;
    const again = button("Send again", () => void this.replay(), { class: "primary", hidden: isUnderWay });
    const remedy = DELIVERY_REMEDIES[state];
    return [
      el("div", { class: "sheet-head" }, el("h1", {}, `Message: ${found.title}`), again),
      this.refusal,
      facts(
        { class: "facts-list" },
        ["State", deliveryChip(found), found.reason === undefined ? "" : ` ${found.reason}`],
        remedy === undefined ? null : ["What to do", remedy],
        ["Receiver", found.url],
        ["Job", el("a", { href: hashOf(["jobs", found.jobID]) }, found.jobID)],
        ["Event", found.type],
        ["Happened", time(found.created)],
        nextAttempt === undefined ? null : ["Next attempt", time(nextAttempt)],
        finished === undefined ? null : ["Over since", time(finished)],
        ["Id", el("code", {}, found.deliveryID)],
      ),
      attempts(found),
      ...(body === undefined ? [] : [rawText("body-title", "Body", bodyText(body))]),
    ];
  }
}

type Attempt = NonNullable<Delivery["attempts"]>[number];

const ATTEMPTS: Column<Attempt>[] = [
  { head: "Nr.", cell: ({ number }) => number },
  { head: "When", cell: ({ at }) => time(at) },
  {
    head: "Took",
    kind: "figure",
    cell: ({ durationMilliseconds: ms }) => (ms === undefined ? "under way" : `${count(ms)}\u202fms`),
  },
  { head: "Result", cell: ({ error, status }) => error ?? (status === undefined ? "–" : `answered ${status}`) },
];

function attempts({ attempts: made = [] }: Delivery): HTMLElement {
  const none = el("p", { class: "hint" }, "None yet. A driver of the service sends it.");
  return el("section", {}, el("h2", {}, "Attempts"), made.length === 0 ? none : table("Attempts", ATTEMPTS, made));
}

const time = (text: string): string => new Date(text).toLocaleString();
