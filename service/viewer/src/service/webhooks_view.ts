/** Webhooks: the receivers of all jobs, the secret of this key, and the log of what was sent. */

import { getJson, request, sendJson } from "../api/requests";
import type { Delivery, EventKind, Secret, Webhook } from "../api/types";
import { actionMenu, type Item } from "../page/action_menu";
import { hashOf, type Address } from "../page/address";
import { ask, openDialog, openForm } from "../page/dialogs";
import { button, el } from "../page/elements";
import { Boxes, choice, field, searchForm } from "../page/form_fields";
import { announce, asProblem, report } from "../page/notices";
import { section, sheet } from "../page/sheet";
import { chip, nothing, sub, table, type Column } from "../page/tables";
import type { View } from "../page/view";
import { WatchedList } from "../page/watched_list";
import { Watching } from "../page/watching";
import { ago } from "../words/numbers";
import { deliveryChip, DELIVERY_WORDS, DeliveryView } from "./delivery_view";

const REFRESH_MS = 4000;

export function showWebhooks(place: HTMLElement, { rest: [part, id] }: Address): View {
  return part === "deliveries" && id !== undefined ? new DeliveryView(place, id) : new Webhooks(place);
}

const nameOf = ({ description, url }: Webhook): string => description ?? url;

class Webhooks extends Watching implements View {
  private readonly receivers = el("div");
  private readonly make = button("New webhook…", () => this.create(), { hidden: true });
  private readonly log: Log;
  private webhooks: Webhook[] = [];
  private kinds: EventKind[] = [];
  private readonly columns: Column<Webhook>[] = [
    {
      head: "Receiver",
      cell: (one) => [
        nameOf(one),
        one.description === undefined ? null : sub(one.url),
        el("span", { class: "sub only-narrow" }, this.eventsOf(one)),
      ],
    },
    { head: "Events", kind: "only-wide", cell: (one) => this.eventsOf(one) },
    {
      head: "State",
      cell: ({ enabled, disabledReason }) => [chip(enabled ? "good" : "warn", enabled ? "enabled" : "disabled"), sub(disabledReason)],
    },
    { head: "Actions", kind: "acts", cell: (one) => actionMenu(nameOf(one), () => this.items(one)) },
  ];

  constructor(place: HTMLElement) {
    super(0);
    this.log = new Log((id) => this.webhooks.find(({ webhookID }) => webhookID === id)?.description ?? null);
    place.replaceChildren(
      sheet(
        "Webhooks",
        [],
        el("p", { class: "hint" }, "The service sends signed messages about jobs to these URLs, and to those that a job names itself."),
        el(
          "section",
          { "aria-labelledby": "receivers-title" },
          el("div", { class: "sheet-head" }, el("h2", { id: "receivers-title" }, "Receivers of all jobs"), el("span", { class: "spacer" }), this.make),
          this.note,
          this.receivers,
        ),
        this.log.element,
        ownSecret(),
      ),
    );
    void this.load();
  }

  follow(address: Address): void {
    this.log.follow(address);
  }

  override leave(): void {
    super.leave();
    this.log.leave();
  }

  // --- receivers

  protected async read(signal: AbortSignal): Promise<boolean> {
    try {
      const found = await getJson<{ webhooks: Webhook[]; eventTypes: EventKind[] }>("webhooks?limit=1000", { signal });
      if (signal.aborted) return false;
      [this.webhooks, this.kinds] = [found.webhooks, found.eventTypes];
    } catch (error) {
      if (asProblem(error).kind !== "forbidden") throw error;
      this.receivers.replaceChildren(nothing("Only keys with the scope admin see and make receivers of all jobs. The messages of your own jobs are below."));
      return false;
    }
    this.make.hidden = false;
    this.log.offer(this.webhooks);
    this.receivers.replaceChildren(
      this.webhooks.length === 0
        ? nothing("No receivers yet. A new one gets the ends of all jobs from then on.")
        : table("Receivers", this.columns, this.webhooks),
    );
    return false;
  }

  private eventsOf({ events }: Webhook): string {
    const chosen = this.kinds.filter(({ type }) => events.includes(type));
    return chosen.map(({ title }) => title).join(", ");
  }

  private items({ webhookID, url }: Webhook): Item[] {
    const path = `webhooks/${encodeURIComponent(webhookID)}`;
    const remove = (): void =>
      ask("Remove the webhook?", `${url} gets nothing more. Messages that wait are dropped; the log stays.`, {
        send: "Remove it",
        act: () => this.changed(path, "DELETE", "It is removed."),
      });
    return [
      { label: "Send what it missed", act: () => this.changed(`${path}/replay`, "POST", "What it missed is sent.") },
      { label: "Its messages", href: hashOf(["webhooks"], { webhook: webhookID }) },
      { label: "Remove…", act: remove },
    ];
  }

  private async changed(path: string, method: string, words: string): Promise<void> {
    await request(path, { method });
    announce(words);
    await this.load();
    this.log.refresh();
  }

  private create(): void {
    const url = el("input", { type: "url", id: "webhook-url", autocomplete: "off", placeholder: "https://hooks.example.org/gablework" });
    const description = el("input", { type: "text", id: "webhook-description", maxlength: 500, autocomplete: "off" });
    const events = new Boxes();
    const usual = this.kinds.filter(({ isDefault }) => isDefault).map(({ type }) => type);
    events.offer(Object.fromEntries(this.kinds.map(({ type, title }) => [type, title])), usual);
    openForm("New webhook", {
      content: [
        field("URL", url, "Public addresses by https; others only if the operator of this service has listed them."),
        el("fieldset", { class: "field" }, el("legend", {}, "Events"), events.element),
        field("Description", description),
      ],
      send: "Make it",
      act: async () => {
        const body = { url: url.value.trim(), events: events.chosen, description: description.value.trim() || null };
        const made = (await (await sendJson("POST", "webhooks", body)).json()) as Secret;
        await this.load();
        return () => showSecret(made);
      },
    });
  }
}

/** The secret of the key. */
function ownSecret(): HTMLElement {
  const note = el("div");
  const show = (): void => {
    note.replaceChildren();
    getJson<Secret>("webhooks/secret").then(showSecret, (error: unknown) => report(note, error));
  };
  const replace = (): void =>
    ask("Replace the secret of this key?", "The old secret signs no longer. Give the new one to the receivers at once.", {
      send: "Replace it",
      act: async () => {
        const secret = (await (await request("webhooks/secret/rotate", { method: "POST" })).json()) as Secret;
        return () => showSecret(secret);
      },
    });
  return section(
    "secret-title",
    "Secret for the subscribers of single jobs",
    el("p", { class: "hint" }, "Messages to the URLs that a job names itself are signed with one secret per key."),
    el("div", { class: "actions" }, button("Show the secret…", show), button("Replace it…", replace, { class: "quiet" })),
    note,
  );
}

/** Show a secret with a button that copies it. */
function showSecret({ secret }: Secret): void {
  const text = el("input", { type: "text", id: "secret", readonly: true, value: secret, spellcheck: "false" });
  const copy = button(
    "Copy",
    () => {
      text.select();
      // only pages by https and of this machine may write to the clipboard by themselves
      (navigator.clipboard === undefined ? Promise.reject(new Error("no clipboard")) : navigator.clipboard.writeText(secret)).then(
        () => (copy.textContent = "Copied"),
        () => (copy.textContent = "Press Ctrl+C"),
      );
    },
    { class: "primary" },
  );
  const { close } = openDialog("The secret", [
    el("p", {}, "Give it to the receiver: it checks with it that messages are from this service. The secret of a webhook is shown only now."),
    field("Secret", text),
    el("div", { class: "actions" }, button("Done", () => close(), { class: "quiet" }), copy),
  ]);
}

/** The log of deliveries, filtered and page by page. */
class Log extends WatchedList<Delivery> {
  readonly element: HTMLElement;
  protected readonly columns: Column<Delivery>[] = [
    {
      head: "Message",
      cell: (one) => [
        el("a", { href: hashOf(["webhooks", "deliveries", one.deliveryID]) }, one.title),
        sub(`of job ${one.jobID.slice(0, 8)}`, el("span", { class: "only-narrow" }, ` · ${ago(one.created)} · ${one.url}`)),
      ],
    },
    {
      head: "Receiver",
      kind: "only-wide url",
      cell: ({ url, webhookID }) => [url, sub(webhookID === undefined ? "named by the job" : (this.nameOf(webhookID) ?? ""))],
    },
    { head: "State", cell: (one) => [deliveryChip(one), sub(one.reason)] },
    { head: "Attempts", kind: "only-wide figure", cell: ({ attemptCount }) => attemptCount },
    {
      head: "When",
      kind: "only-wide when",
      cell: ({ created }) => ago(created),
      title: ({ created }) => new Date(created).toLocaleString(),
    },
  ];
  private readonly state = choice("log-state", { "": "any", ...DELIVERY_WORDS });
  private readonly receiver = choice("log-receiver", { "": "any" });
  private readonly job = el("input", { type: "text", id: "log-job", autocomplete: "off", spellcheck: "false" });
  protected readonly empty = "No messages yet: no job has named a receiver, or nothing has happened since.";
  protected readonly filters = { job: this.job, state: this.state, webhook: this.receiver };

  constructor(private readonly nameOf: (webhook: string) => string | null) {
    super({ name: "Messages", noun: "message", path: "webhooks/deliveries", member: "deliveries", words: ["webhooks"], refreshMs: REFRESH_MS });
    const search = (): void => {
      location.hash = this.asked();
    };
    const form = searchForm("Messages", search, field("Id of the job", this.job), field("State", this.state), field("Receiver", this.receiver));
    this.element = section("log-title", "Messages", form, this.note, this.frame, this.pages);
  }

  /** Offer the receivers as a filter. */
  offer(webhooks: readonly Webhook[]): void {
    const options = Object.entries({ "": "any", ...Object.fromEntries(webhooks.map((one) => [one.webhookID, nameOf(one)])) });
    this.receiver.replaceChildren(...options.map(([value, label]) => el("option", { value }, label)));
    this.receiver.value = this.query["webhook"] ?? "";
    this.refresh();
  }

  protected mayChange({ state }: Delivery): boolean {
    return state === "waiting";
  }
}
