/** One message of the log: its attempts, its body, and a way to send it again. */

import { getJson, request } from "../api/requests";
import type { Delivery } from "../api/types";
import { hashOf } from "../page/address";
import { el } from "../page/elements";
import { announce, asProblem, problemNotice } from "../page/notices";
import { fact, table } from "../page/tables";
import type { Hooks, View } from "../page/view";
import { Watching } from "../page/watching";
import { count } from "../words/numbers";

const REFRESH_MS = 2000;

export const DELIVERY_WORDS: Record<string, string> = {
  waiting: "waiting",
  delivered: "delivered",
  failed: "failed",
  gone: "refused for good",
  dropped: "dropped",
};

/** What to do about a message that did not arrive. */
export function deliveryRemedy(state: string): string {
  switch (state) {
    case "failed":
      return "Mend the receiver, then send the message again.";
    case "gone":
      return "The receiver answered that it wants no more messages. If that was a mistake, choose “Send what it missed” for the webhook.";
    case "dropped":
      return "It was no longer needed. You can still send it again.";
    default:
      return "";
  }
}

/** The body as it reads best; as it was sent if it is not JSON. */
export function bodyText(body: string): string {
  try {
    return JSON.stringify(JSON.parse(body), null, 2);
  } catch {
    return body;
  }
}

export function showDelivery(place: HTMLElement, id: string, hooks: Hooks): View {
  const view = new DeliveryView(place, hooks, id);
  view.follow();
  return view;
}

class DeliveryView extends Watching implements View {
  private shown = "";
  private readonly path: string;
  private readonly sheet = el("div", { class: "sheet" }, el("p", { class: "loading" }, "Loading…"), this.note);
  /** Says why it was not sent again. */
  private readonly refusal = el("div");

  constructor(place: HTMLElement, hooks: Hooks, id: string) {
    super(hooks, REFRESH_MS);
    this.path = `webhooks/deliveries/${encodeURIComponent(id)}`;
    document.title = "Message · gablework";
    place.replaceChildren(this.sheet);
  }

  follow(): void {
    void this.load();
  }

  protected async read(signal: AbortSignal): Promise<boolean> {
    try {
      const found = await getJson<Delivery>(this.path, { signal });
      const state = JSON.stringify(found);
      if (!signal.aborted && state !== this.shown) {
        if (this.shown !== "") announce(`The message is ${DELIVERY_WORDS[found.state] ?? found.state}.`);
        this.shown = state;
        this.draw(found);
      }
      return found.state === "waiting";
    } catch (error) {
      if (!signal.aborted && this.shown === "") this.sheet.replaceChildren(backLink(), this.note);
      throw error;
    }
  }

  private async replay(): Promise<void> {
    this.refusal.replaceChildren();
    try {
      await request(`${this.path}/replay`, { method: "POST" });
    } catch (error) {
      const problem = asProblem(error);
      this.refusal.replaceChildren(problemNotice(problem));
      this.hooks.onProblem(problem);
      return;
    }
    announce("The message is sent again.");
    await this.load();
  }

  private draw(found: Delivery): void {
    const again = el("button", { type: "button", class: "primary", hidden: found.state === "waiting" && found.attemptCount === 0 }, "Send again");
    again.addEventListener("click", () => void this.replay());
    const hadFocus = this.sheet.contains(document.activeElement) && document.activeElement?.tagName === "BUTTON";
    const remedy = deliveryRemedy(found.state);
    this.sheet.replaceChildren(
      el("div", { class: "sheet-head" }, el("h1", {}, `Message: ${found.title}`), again),
      backLink(),
      this.note,
      this.refusal,
      el(
        "dl",
        { class: "facts-list" },
        ...fact("State", el("span", { class: `chip chip-${found.state}` }, DELIVERY_WORDS[found.state] ?? found.state), found.reason === undefined ? "" : ` ${found.reason}`),
        ...(remedy === "" ? [] : fact("What to do", remedy)),
        ...fact("Receiver", found.url),
        ...fact("Job", el("a", { href: hashOf(["jobs", found.jobID]) }, found.jobID)),
        ...fact("Event", found.type),
        ...fact("Happened", time(found.created)),
        ...(found.nextAttempt === undefined ? [] : fact("Next attempt", time(found.nextAttempt))),
        ...(found.finished === undefined ? [] : fact("Over since", time(found.finished))),
        ...fact("Id", el("code", {}, found.deliveryID)),
      ),
      attempts(found),
      ...(found.body === undefined
        ? []
        : [el("section", {}, el("h2", { id: "body-title" }, "Body"), el("pre", { class: "raw", tabindex: 0, role: "region", "aria-labelledby": "body-title" }, bodyText(found.body)))]),
    );
    if (hadFocus) again.focus();
  }
}

function attempts({ attempts: made }: Delivery): HTMLElement {
  const title = el("h2", {}, "Attempts");
  if (made === undefined || made.length === 0) return el("section", {}, title, el("p", { class: "hint" }, "None yet. A driver of the service sends it."));
  const rows = made.map(({ number, at, durationMilliseconds, status, error }) =>
    el(
      "tr",
      {},
      el("td", {}, number),
      el("td", {}, time(at)),
      el("td", { class: "figure" }, durationMilliseconds === undefined ? "under way" : `${count(durationMilliseconds)}\u202fms`),
      el("td", {}, error ?? (status === undefined ? "–" : `answered ${status}`)),
    ),
  );
  return el("section", {}, title, table("Attempts", ["Nr.", "When", "Took", "Result"], rows));
}

function backLink(): HTMLElement {
  return el("p", {}, el("a", { href: "#/webhooks" }, "← All messages"));
}

const time = (text: string): string => new Date(text).toLocaleString();
