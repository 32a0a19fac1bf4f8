import { waited } from "../api/event_stream";
import { getJson } from "../api/requests";
import type { Feature } from "../api/types";
import { pathOf, ringsOf, type Point } from "../models/plan";
import { el, svg } from "../page/elements";
import { counted } from "../words/numbers";
import { CATEGORIES, categoryOf } from "../words/roof_types";

const PAUSE_MS = 3000;
const PAGE = 1000; // buildings
const MOST_DRAWN = 5000; // more outlines than that make the page slow; they are only counted
const MARGIN = 0.03; // of the longer side

interface Page {
  complete: boolean;
  attempt?: number;
  features: Feature[];
}

/** The outlines of a running job's buildings, seen from above, as they are modelled. */
export class BuildingsSoFar {
  private readonly plan = svg("svg", { role: "img", "aria-label": "Outlines of the buildings so far, seen from above" });
  private readonly words = el("figcaption");
  readonly element = el("figure", { class: "so-far", hidden: true }, this.plan, this.words);
  private attempt = 0;
  private known = 0;
  private origin: Point | null = null;
  private begun = false;

  constructor(
    private readonly jobPath: string,
    private readonly signal: AbortSignal,
  ) {}

  /** Ask for buildings again and again, until the job is over or the page shows something else. */
  begin(): void {
    if (this.begun) return;
    this.begun = true;
    this.follow().catch(() => undefined); // the page shows something else
  }

  private async follow(): Promise<void> {
    // where the answer is a problem, the events of the job tell it, too
    while (!(await this.ask().catch(() => false))) {
      await waited(PAUSE_MS, this.signal);
      if (!this.element.isConnected) return;
    }
  }

  /** Draw what is new; true if the job is over. */
  private async ask(): Promise<boolean> {
    const offset = this.known;
    const path = `${this.jobPath}/buildings?crs=native&limit=${PAGE}&offset=${offset}`;
    const page = await getJson<Page>(path, { signal: this.signal });
    if (page.complete) return true;
    const isAnew = page.attempt !== this.attempt;
    if (isAnew) this.clear(page.attempt ?? 0);
    // the job began anew, and so does its list: this page lies somewhere within it
    if (!isAnew || offset === 0) this.take(page);
    return false;
  }

  private clear(attempt: number): void {
    this.attempt = attempt;
    this.known = 0;
    this.origin = null;
    this.plan.replaceChildren();
  }

  private take(page: Page): void {
    for (const feature of page.features) this.draw(feature);
    this.known += page.features.length;
    this.element.hidden = this.known === 0;
    this.words.textContent = `${counted(this.known, "building")} so far`;
    const { x, y, width, height } = this.plan.getBBox();
    const margin = MARGIN * Math.max(width, height);
    this.plan.setAttribute("viewBox", [x - margin, y - margin, width + 2 * margin, height + 2 * margin].join(" "));
  }

  private draw({ geometry, properties }: Feature): void {
    const rings = ringsOf(geometry);
    const first = rings[0]?.[0];
    if (first === undefined || this.plan.childElementCount >= MOST_DRAWN) return;
    const [x0, y0] = (this.origin ??= first);
    const d = pathOf(rings, ([x, y]) => [x - x0, y0 - y], 2); // north up
    const { colour } = CATEGORIES[categoryOf(properties["status"], properties["roof_type"])];
    this.plan.append(svg("path", { d, fill: colour, "fill-rule": "evenodd" }));
  }
}
