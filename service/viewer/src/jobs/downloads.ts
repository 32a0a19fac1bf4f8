import { waited } from "../api/event_stream";
import { currentKey, getJson, partOf, request, serviceUrl, type Run } from "../api/requests";
import type { Link } from "../api/types";
import { dropDown } from "../page/action_menu";
import { el } from "../page/elements";
import { asProblem, problemNotice } from "../page/notices";
import { bytes, counted } from "../words/numbers";

/**
 * A link that saves a file, which the service names. With a key the file is fetched with it first, since a link cannot
 * carry a header and a key never goes into an address.
 */
export function downloadLink(label: string, path: string, ...more: HTMLElement[]): HTMLAnchorElement {
  const link = el("a", { href: serviceUrl(path), download: true }, label, ...more);
  link.addEventListener("click", (event) => {
    if (currentKey() === null) return;
    event.preventDefault();
    link.setAttribute("aria-busy", "true");
    save(path)
      .catch((error: unknown) => void link.after(problemNotice(asProblem(error))))
      .finally(() => link.removeAttribute("aria-busy"));
  });
  return link;
}

async function save(path: string): Promise<void> {
  const response = await request(path, { headers: { Accept: "*/*" } });
  const [, name = ""] = /filename="([^"]+)"/.exec(response.headers.get("Content-Disposition") ?? "") ?? [];
  const address = URL.createObjectURL(await response.blob());
  el("a", { href: address, download: name }).click();
  // the browser reads the blob after the click, so it must still exist then
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}

/** A link to the page of a comparison; with a key the page can only be saved and then opened. */
export function pageLink(jobPath: string, name: string): HTMLAnchorElement {
  const path = `${jobPath}/results/page`;
  if (currentKey() !== null) {
    const saved = downloadLink("Save the comparison", path);
    saved.setAttribute("aria-label", `Save: ${name}`);
    return saved;
  }
  return el("a", { href: serviceUrl(path), target: "_blank", rel: "noopener", "aria-label": name }, "Comparison");
}

type Offered = Record<string, Link & { bytes?: number }>;

/** The query for the buildings that are ok alone. */
const OK = "?status=ok";

/** Milliseconds between two questions whether a selection of buildings is made. */
const ASK_AGAIN_MS = 2000;

/**
 * A menu of all outputs of the job; for a comparison those of one run, then those of all. Where some buildings are not
 * ok, it offers the outputs of the others alone.
 */
export async function downloadMenu(run: Run, statuses: Record<string, number>, signal: AbortSignal): Promise<HTMLElement> {
  const list = await downloadList(run, signal);
  const { ok = 0, ...others } = statuses;
  if (ok > 0 && Object.values(others).some((count) => count > 0)) list.prepend(onlyOk(list, ok, run, signal));
  return dropDown(el("summary", { class: "button primary" }, "Download"), list);
}

/** A switch between the outputs of all buildings and those of the ones that are ok. */
function onlyOk(list: HTMLElement, count: number, run: Run, signal: AbortSignal): HTMLElement {
  const all = [...list.children];
  const box = el("input", { type: "checkbox" });
  const entry = el("li", { class: "menu-choice" }, el("label", {}, box, ` Only the ${counted(count, "model")} that ${count === 1 ? "is" : "are"} ok`));
  // the switch stays where it is, so it keeps the focus
  const show = (entries: Element[]): void => {
    for (const other of [...list.children]) if (other !== entry) other.remove();
    list.append(...entries);
  };
  box.addEventListener("change", () => {
    if (!box.checked) return show(all);
    show([el("li", { class: "hint menu-wait", role: "status" }, "These files are being made…")]);
    selected(run, signal)
      .then((offered) => listed(offered, run, OK))
      .catch((error: unknown) => [el("li", {}, problemNotice(asProblem(error)))])
      .then((entries) => {
        if (box.checked) show(entries);
      });
  });
  return entry;
}

/** The outputs of a selection, once they are made. */
async function selected(run: Run, signal: AbortSignal): Promise<Offered> {
  for (;;) {
    try {
      return await getJson<Offered>(partOf(run, `results${OK}`), { signal });
    } catch (error) {
      if (asProblem(error).kind !== "selection-busy") throw error;
      await waited(ASK_AGAIN_MS, signal);
    }
  }
}

/** A list of the same outputs. */
export async function downloadList(run: Run, signal: AbortSignal): Promise<HTMLElement> {
  const offer = (of: Run): Promise<Offered> => getJson<Offered>(partOf(of, "results"), { signal });
  const entries = listed(await offer(run), run);
  if (run.method !== null) {
    const comparison = { jobPath: run.jobPath, method: null };
    const { page: _page, ...compared } = await offer(comparison); // the page has a link of its own
    entries.push(...listed(compared, comparison));
  }
  return el("ul", { class: "outputs" }, ...entries);
}

/** Entries of the menu in the words of the service. */
function listed(offered: Offered, run: Run, query = ""): HTMLElement[] {
  return Object.entries(offered).map(([name, { title = name, bytes: size }]) => {
    const weight = el("span", { class: "menu-size" }, typeof size === "number" ? bytes(size) : "");
    return el("li", {}, downloadLink(title, partOf(run, `results/${name}${query}`), weight));
  });
}
