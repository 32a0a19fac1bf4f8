/** Webhooks: the receivers of all jobs, the secret of this key, and the log of what was sent. */

import { getJson, request, type Problem } from "../api/requests";
import type { Delivery, EventKind, Secret, Webhook } from "../api/types";
import { actionMenu, type Item } from "../page/action_menu";
import { hashOf, type Address } from "../page/address";
import { ask, openDialog, openForm } from "../page/dialogs";
import { el } from "../page/elements";
import { choice, field } from "../page/form_fields";
import { announce, asProblem, problemNotice } from "../page/notices";
import { offsetOf, pager } from "../page/paging";
import { nothing, table } from "../page/tables";
import type { Hooks, View } from "../page/view";
import { Watching } from "../page/watching";
import { ago } from "../words/numbers";
import { DELIVERY_WORDS, showDelivery } from "./delivery_view";
import "../page/pages.css";

const SIZE = 25;
const REFRESH_MS = 4000;
const LOG_HEADS = ["Message", ["Receiver", "only-wide"], "State", ["Attempts", "only-wide"], ["When", "only-wide"]] as const;

export function showWebhooks(place: HTMLElement, address: Address, hooks: Hooks): View {
  const [part, id] = address.rest;
  if (part === "deliveries" && id !== undefined) return showDelivery(place, id, hooks);
  const view = new Webhooks(place, hooks);
  view.follow(address);
  return view;
}

const change = (path: string, method: string, body?: unknown): Promise<Response> =>
  request(path, {
    method,
    ...(body === undefined ? {} : { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) }),
  });

class Webhooks implements View {
  private readonly calledOff = new AbortController();
  private readonly receivers = el("div");
  private readonly make = el("button", { type: "button", hidden: true }, "New webhook…");
  private readonly log: Log;
  private webhooks: Webhook[] = [];
  private kinds: EventKind[] = [];

  constructor(
    place: HTMLElement,
    private readonly hooks: Hooks,
  ) {
    document.title = "Webhooks · gablework";
    this.log = new Log(hooks, (id) => this.webhooks.find(({ webhookID }) => webhookID === id)?.description ?? null);
    this.make.addEventListener("click", () => this.create());
    place.replaceChildren(
      el(
        "div",
        { class: "sheet" },
        el("div", { class: "sheet-head" }, el("h1", {}, "Webhooks")),
        el("p", { class: "hint" }, "The service sends signed messages about jobs to these URLs, and to those that a job names itself."),
        el(
          "section",
          { "aria-labelledby": "receivers-title" },
          el("div", { class: "sheet-head" }, el("h2", { id: "receivers-title" }, "Receivers of all jobs"), el("span", { class: "spacer" }), this.make),
          this.receivers,
        ),
        this.log.element,
        this.ownSecret(),
      ),
    );
    void this.load();
  }

  follow({ query }: Address): void {
    this.log.show(query);
  }

  leave(): void {
    this.calledOff.abort();
    this.log.leave();
  }

  // --- receivers

  private async load(): Promise<void> {
    const { signal } = this.calledOff;
    try {
      const found = await getJson<{ webhooks: Webhook[]; eventTypes: EventKind[] }>("webhooks?limit=1000", { signal });
      [this.webhooks, this.kinds] = [found.webhooks, found.eventTypes];
      if (signal.aborted) return;
      this.make.hidden = false;
      this.log.offer(this.webhooks);
      this.draw();
    } catch (error) {
      if (signal.aborted) return;
      const problem = asProblem(error);
      const kept =
        problem.kind === "forbidden"
          ? nothing("Only keys with the scope admin see and make receivers of all jobs. The messages of your own jobs are below.")
          : problemNotice(problem, () => void this.load());
      this.receivers.replaceChildren(kept);
      this.hooks.onProblem(problem);
    }
  }

  private draw(): void {
    const rows = this.webhooks.map((one) => this.row(one));
    this.receivers.replaceChildren(
      rows.length === 0
        ? nothing("No receivers yet. A new one gets the ends of all jobs from then on.")
        : table("Receivers", ["Receiver", ["Events", "only-wide"], "State", ["Actions", "acts"]], rows),
    );
  }

  private row(one: Webhook): HTMLElement {
    const path = `webhooks/${encodeURIComponent(one.webhookID)}`;
    const events = this.kinds
      .filter(({ type }) => one.events.includes(type))
      .map(({ title }) => title)
      .join(", ");
    const items: Item[] = [
      { label: "Send what it missed", act: () => this.changed(change(`${path}/replay`, "POST"), "What it missed is sent.") },
      { label: "Its messages", href: hashOf(["webhooks"], { webhook: one.webhookID }) },
      { label: "Remove…", act: () => this.remove(one, path) },
    ];
    const name = one.description ?? one.url;
    return el(
      "tr",
      {},
      el(
        "th",
        { scope: "row" },
        name,
        one.description === undefined ? null : el("span", { class: "sub" }, one.url),
        el("span", { class: "sub only-narrow" }, events),
      ),
      el("td", { class: "only-wide" }, events),
      el(
        "td",
        {},
        el("span", { class: `chip ${one.enabled ? "chip-good" : "chip-warn"}` }, one.enabled ? "enabled" : "disabled"),
        one.disabledReason === undefined ? null : el("span", { class: "sub" }, one.disabledReason),
      ),
      el("td", { class: "acts" }, actionMenu(name, () => items, this.hooks.onProblem)),
    );
  }

  private remove({ url }: Webhook, path: string): void {
    ask({
      title: "Remove the webhook?",
      text: `${url} gets nothing more. Messages that wait are dropped; the log stays.`,
      yes: "Remove it",
      act: () => this.changed(change(path, "DELETE"), "It is removed."),
      onProblem: this.hooks.onProblem,
    });
  }

  private async changed(done: Promise<unknown>, words: string): Promise<void> {
    await done;
    announce(words);
    await this.load();
    this.log.refresh();
  }

  private create(): void {
    const url = el("input", { type: "url", id: "webhook-url", autocomplete: "off", placeholder: "https://hooks.example.org/gablework", "aria-describedby": "webhook-url-hint" });
    const description = el("input", { type: "text", id: "webhook-description", maxlength: 500, autocomplete: "off" });
    const boxes = this.kinds.map(({ type, title, isDefault }) => {
      const box = el("input", { type: "checkbox", value: type, checked: isDefault });
      return { box, label: el("label", {}, box, ` ${title}`) };
    });
    openForm({
      title: "New webhook",
      content: [
        el(
          "div",
          { class: "field" },
          el("label", { for: url.id }, "URL"),
          url,
          el("p", { class: "hint", id: "webhook-url-hint" }, "Public addresses by https; others only if the operator of this service has listed them."),
        ),
        el("fieldset", { class: "field" }, el("legend", {}, "Events"), el("div", { class: "boxes" }, ...boxes.map(({ label }) => label))),
        el("div", { class: "field" }, el("label", { for: description.id }, "Description"), description),
      ],
      send: "Make it",
      act: async () => {
        const body = {
          url: url.value.trim(),
          events: boxes.filter(({ box }) => box.checked).map(({ box }) => box.value),
          description: description.value.trim() || null,
        };
        const made = (await (await change("webhooks", "POST", body)).json()) as Secret;
        await this.load();
        return () => showSecret(made);
      },
      onProblem: this.hooks.onProblem,
    });
  }

  // --- the secret of the key

  private ownSecret(): HTMLElement {
    const note = el("div");
    const fail = (error: unknown): void => {
      const problem: Problem = asProblem(error);
      note.replaceChildren(problemNotice(problem));
      this.hooks.onProblem(problem);
    };
    const show = el("button", { type: "button" }, "Show the secret…");
    show.addEventListener("click", () => {
      note.replaceChildren();
      getJson<Secret>("webhooks/secret").then((secret) => showSecret(secret), fail);
    });
    const replace = el("button", { type: "button", class: "quiet" }, "Replace it…");
    replace.addEventListener("click", () =>
      ask({
        title: "Replace the secret of this key?",
        text: "The old secret signs no longer. Give the new one to the receivers at once.",
        yes: "Replace it",
        act: async () => {
          const secret = (await (await change("webhooks/secret/rotate", "POST")).json()) as Secret;
          return () => showSecret(secret);
        },
        onProblem: this.hooks.onProblem,
      }),
    );
    return el(
      "section",
      { "aria-labelledby": "secret-title" },
      el("h2", { id: "secret-title" }, "Secret for the subscribers of single jobs"),
      el("p", { class: "hint" }, "Messages to the URLs that a job names itself are signed with one secret per key."),
      el("div", { class: "actions" }, show, replace),
      note,
    );
  }
}

/** Show a secret with a button that copies it. */
function showSecret({ secret }: Secret): void {
  const field = el("input", { type: "text", id: "secret", readonly: true, value: secret, spellcheck: "false" });
  const copy = el("button", { type: "button", class: "primary" }, "Copy");
  const done = el("button", { type: "button", class: "quiet" }, "Done");
  copy.addEventListener("click", () => {
    field.select();
    // only pages by https and of this machine may write to the clipboard by themselves
    (navigator.clipboard === undefined ? Promise.reject(new Error("no clipboard")) : navigator.clipboard.writeText(secret)).then(
      () => (copy.textContent = "Copied"),
      () => (copy.textContent = "Press Ctrl+C"),
    );
  });
  const { close } = openDialog("The secret", [
    el("p", {}, "Give it to the receiver: it checks with it that messages are from this service. The secret of a webhook is shown only now."),
    el("div", { class: "field" }, el("label", { for: field.id }, "Secret"), field),
    el("div", { class: "actions" }, done, copy),
  ]);
  done.addEventListener("click", close);
}

/** The log of deliveries, filtered and page by page. */
class Log extends Watching {
  readonly element: HTMLElement;
  private query = new URLSearchParams();
  private shown = "";
  private readonly state = choice("log-state", { "": "any", ...DELIVERY_WORDS });
  private readonly receiver = choice("log-receiver", { "": "any" });
  private readonly job = el("input", { type: "text", id: "log-job", autocomplete: "off", spellcheck: "false" });
  private readonly frame = el("div");
  private readonly pages = el("div");

  constructor(
    hooks: Hooks,
    private readonly nameOf: (webhook: string) => string | null,
  ) {
    super(hooks, REFRESH_MS);
    const form = el(
      "form",
      { class: "search", role: "search", "aria-label": "Messages" },
      field("Id of the job", this.job),
      field("State", this.state),
      field("Receiver", this.receiver),
    );
    const search = (): void => {
      const query = { job: this.job.value.trim(), state: this.state.value, webhook: this.receiver.value };
      location.hash = hashOf(["webhooks"], query);
    };
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      search();
    });
    for (const control of [this.job, this.state, this.receiver]) control.addEventListener("change", search);
    this.element = el("section", { "aria-labelledby": "log-title" }, el("h2", { id: "log-title" }, "Messages"), form, this.note, this.frame, this.pages);
  }

  /** Offer the receivers as a filter. */
  offer(webhooks: readonly Webhook[]): void {
    this.receiver.replaceChildren(
      el("option", { value: "" }, "any"),
      ...webhooks.map(({ webhookID, description, url }) => el("option", { value: webhookID }, description ?? url)),
    );
    this.receiver.value = this.query.get("webhook") ?? "";
    this.shown = "";
    this.refresh();
  }

  show(query: URLSearchParams): void {
    this.query = query;
    this.job.value = query.get("job") ?? "";
    this.state.value = query.get("state") ?? "";
    this.receiver.value = query.get("webhook") ?? "";
    this.shown = "";
    void this.load();
  }

  refresh(): void {
    void this.load();
  }

  protected async read(signal: AbortSignal): Promise<boolean> {
    const offset = offsetOf(this.query.get("offset"));
    const asked = new URLSearchParams({ limit: String(SIZE), offset: String(offset) });
    for (const name of ["job", "state", "webhook"]) {
      const value = this.query.get(name);
      if (value !== null && value !== "") asked.set(name, value);
    }
    const answer = await getJson<{ deliveries: Delivery[]; links: { rel?: string }[] }>(`webhooks/deliveries?${asked}`, { signal });
    if (signal.aborted) return false;
    this.draw(answer.deliveries, offset, answer.links.some(({ rel }) => rel === "next"));
    return answer.deliveries.some(({ state }) => state === "waiting");
  }

  private draw(deliveries: Delivery[], offset: number, hasNext: boolean): void {
    const state = JSON.stringify(deliveries);
    if (state === this.shown) return;
    this.shown = state;
    const focused = this.frame.contains(document.activeElement) ? document.activeElement?.getAttribute("href") : null;
    const isFiltered = ["job", "state", "webhook"].some((name) => (this.query.get(name) ?? "") !== "");
    if (deliveries.length === 0) {
      const words = isFiltered ? "No message fits. " : "No messages yet: no job has named a receiver, or nothing has happened since.";
      this.frame.replaceChildren(nothing(words, isFiltered ? el("a", { href: "#/webhooks" }, "Show all messages") : null));
    } else {
      const now = new Date();
      this.frame.replaceChildren(table("Messages", LOG_HEADS, deliveries.map((one) => this.row(one, now))));
    }
    if (focused != null) this.frame.querySelector<HTMLAnchorElement>(`a[href="${CSS.escape(focused)}"]`)?.focus();
    const page = { offset, size: SIZE, shown: deliveries.length, total: null, hasNext };
    this.pages.replaceChildren(pager(page, (to) => hashOf(["webhooks"], { ...Object.fromEntries(this.query), offset: to === 0 ? "" : String(to) })));
  }

  private row(one: Delivery, now: Date): HTMLElement {
    const receiver = one.webhookID === undefined ? "named by the job" : (this.nameOf(one.webhookID) ?? "");
    const when = ago(new Date(one.created), now);
    return el(
      "tr",
      {},
      el(
        "th",
        { scope: "row" },
        el("a", { href: hashOf(["webhooks", "deliveries", one.deliveryID]) }, one.title),
        el("span", { class: "sub" }, `of job ${one.jobID.slice(0, 8)}`, el("span", { class: "only-narrow" }, ` · ${when} · ${one.url}`)),
      ),
      el("td", { class: "only-wide url" }, one.url, receiver === "" ? null : el("span", { class: "sub" }, receiver)),
      el(
        "td",
        {},
        el("span", { class: `chip chip-${one.state}` }, DELIVERY_WORDS[one.state] ?? one.state),
        one.reason === undefined ? null : el("span", { class: "sub" }, one.reason),
      ),
      el("td", { class: "only-wide figure" }, one.attemptCount),
      el("td", { class: "only-wide when", title: new Date(one.created).toLocaleString() }, when),
    );
  }
}
