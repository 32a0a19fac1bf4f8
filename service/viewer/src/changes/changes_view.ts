/** Two runs side by side, by one camera: methods of a comparison, other settings, or two epochs; and what differs. */

import { getJson, pathOfJob } from "../api/requests";
import type { StatusInfo } from "../api/types";
import { titleOf, whenWords } from "../jobs/job_words";
import type { Batch, Gathered, Listed } from "../models/batching";
import { originInMetres } from "../models/building_mesh";
import { figureWords } from "../models/figures";
import { CHANGES, LIMITS, makersNote, pairs, type Change, type Pair, type Placed } from "../models/pairing";
import { RunObjects } from "../models/run_objects";
import { countOf } from "../models/selection";
import { hashOf, partsOf, type Address } from "../page/address";
import { button, colourSwatch, el, refill, type Properties } from "../page/elements";
import { choice, field } from "../page/form_fields";
import { announce, report, warningNotice } from "../page/notices";
import { sheet } from "../page/sheet";
import { nothing, table, type Column } from "../page/tables";
import { Tick } from "../page/tick";
import type { View } from "../page/view";
import type { OnMove } from "../scene/camera";
import { ModelScene } from "../scene/scene";
import { count, counted } from "../words/numbers";
import { CATEGORIES } from "../words/roof_types";
import "./changes_view.css";

const OFFERED = 100;
const STEP = 100;

/** One side: a job, and the run of it if it is a comparison. */
interface Side {
  job: string;
  method: string | null;
}

/** What was read of a side. */
interface Loaded {
  objects: RunObjects;
  batches: Batch[];
}

export const showChanges = (place: HTMLElement): View => new Changes(place);

class Changes implements View {
  private calledOff = new AbortController();
  private sides: [Side | null, Side | null] = [null, null];
  private scenes: [ModelScene | null, ModelScene | null] = [null, null];
  private shownSides = "";
  private selected: string | null = null;
  private found: Pair[] = [];
  private more = STEP;
  private readonly hidden = new Set<Change>(["same"]);
  private readonly selects = [choice("side-old", {}), choice("side-new", {})] as const;
  private readonly note = el("div");
  private readonly stage = el("div", { class: "pair", hidden: true });
  private readonly legend = el("div", { class: "legend", role: "group", "aria-label": "Shown changes", hidden: true });
  private readonly list = el("div");
  private readonly explanation = el(
    "p",
    { class: "hint", hidden: true },
    `Buildings belong together by their id, otherwise by the overlap of their plans. Heights count from ${LIMITS.heightM} m, footprints from ` +
      `${100 * LIMITS.areaShare} % and ${LIMITS.areaM2} m². It is a quick look: gablework batch diff judges two surveys with their accuracy.`,
  );

  private readonly columns: Column<Pair>[] = [
    {
      head: "Building",
      cell: (pair) => [
        el("a", { class: "change", href: this.address(idOf(pair)) }, colourSwatch(CHANGES[pair.change].colour), CHANGES[pair.change].label),
        el("span", { class: "sub" }, el("code", {}, idOf(pair).slice(0, 10))),
      ],
    },
    { head: "What differs", cell: ({ differences, change }) => differences.join("; ") || CHANGES[change].words },
    { head: "Left", kind: "only-wide", cell: (pair) => figures(pair.old) },
    { head: "Right", kind: "only-wide", cell: (pair) => figures(pair.new) },
  ];

  constructor(place: HTMLElement) {
    const [old, now] = this.selects;
    for (const select of this.selects) select.addEventListener("change", () => this.choose());
    const swap = (): void => {
      [old.value, now.value] = [now.value, old.value];
      this.choose();
    };
    const swapper = button("⇄", swap, { "aria-label": "Swap left and right" });
    const sides = el("div", { class: "sides" }, field("Left, or older", old), swapper, field("Right, or newer", now));
    const all = sheet("Side by side", [], sides, this.note, this.stage, this.legend, this.list, this.explanation);
    all.classList.add("sheet-wide");
    place.replaceChildren(all);
  }

  follow({ query }: Address): void {
    const side = (name: string): Side | null => {
      const job = query.get(name);
      return job === null || job === "" ? null : { job, method: query.get(`${name}Method`) };
    };
    this.sides = [side("old"), side("new")];
    this.selected = query.get("building");
    const words = JSON.stringify(this.sides);
    if (words === this.shownSides) {
      this.select();
      return;
    }
    this.shownSides = words;
    this.leave();
    const { signal } = (this.calledOff = new AbortController());
    this.load(signal).catch((error: unknown) => {
      if (signal.aborted) return;
      report(this.note, error, () => {
        this.shownSides = "";
        this.follow(partsOf(location.hash));
      });
    });
  }

  leave(): void {
    this.calledOff.abort();
    for (const scene of this.scenes) scene?.dispose();
    this.scenes = [null, null];
  }

  // --- which runs

  private address(building: string | null): string {
    const [old, now] = this.sides;
    return hashOf(["changes"], {
      old: old?.job ?? "",
      oldMethod: old?.method ?? "",
      new: now?.job ?? "",
      newMethod: now?.method ?? "",
      building: building ?? "",
    });
  }

  private choose(): void {
    const read = (value: string): Side | null => (value === "" ? null : (JSON.parse(value) as Side));
    this.sides = [read(this.selects[0].value), read(this.selects[1].value)];
    location.hash = this.address(null);
  }

  /** Offer the runs of the newest jobs, and those of the address. */
  private async offer(signal: AbortSignal): Promise<void> {
    const query = new URLSearchParams({ status: "successful", processID: "reconstruct,compare", limit: String(OFFERED) });
    const { jobs } = await getJson<{ jobs: StatusInfo[] }>(`jobs?${query}`, { signal });
    for (const side of this.sides) {
      if (side === null || jobs.some(({ jobID }) => jobID === side.job)) continue;
      jobs.unshift(await getJson<StatusInfo>(pathOfJob(side.job), { signal }));
    }
    this.selects.forEach((select, at) => {
      const side = this.sides[at] ?? null;
      select.replaceChildren(
        el("option", { value: "" }, "choose a run"),
        ...jobs.flatMap((job) => {
          const runs: (string | null)[] = job.summary?.runs === undefined ? [null] : Object.keys(job.summary.runs);
          return runs.map((method) => {
            const words = [titleOf(job), method, whenWords(job)].filter(Boolean);
            const isChosen = side?.job === job.jobID && (side.method ?? runs[0]) === method;
            return el("option", { value: JSON.stringify({ job: job.jobID, method }), selected: isChosen }, words.join(" · "));
          });
        }),
      );
    });
  }

  // --- loading

  private async load(signal: AbortSignal): Promise<void> {
    this.stage.hidden = this.legend.hidden = this.explanation.hidden = true;
    this.list.replaceChildren();
    this.note.replaceChildren(el("p", { class: "loading" }, "Loading…"));
    await this.offer(signal);
    if (signal.aborted) return;
    const [old, now] = this.sides;
    if (old === null || now === null) {
      const words = this.selects[0].options.length < 2 ? "There are no finished models yet." : "Choose the runs that are shown side by side.";
      this.note.replaceChildren(nothing(words));
      return;
    }
    const [before, after] = await Promise.all([read(old, signal), read(now, signal)]);
    if (signal.aborted) return;
    const [older, newer] = [before, after].map(({ objects }) => objects.report.crs ?? {});
    if ((older.wkt ?? older.name ?? null) !== (newer.wkt ?? newer.name ?? null)) {
      this.note.replaceChildren(
        warningNotice(`The runs have different coordinate reference systems, ${older.name ?? "unknown"} and ${newer.name ?? "unknown"}: they cannot be laid side by side.`),
      );
      return;
    }
    const notes = [makersNote(before.objects.report, after.objects.report)].filter((note) => note !== "");
    this.note.replaceChildren(...notes.map((note) => warningNotice(note)));
    const shift = shiftOf(before, after);
    this.found = sorted(pairs(placed(before, [0, 0]), placed(after, shift)));
    this.draw([before, after], shift);
    this.more = STEP;
    this.fill();
    this.select();
    const differing = this.found.filter(({ change }) => change !== "same").length;
    announce(`${counted(this.found.length, "building")}, ${differing} of them differ.`);
  }

  private draw(loaded: readonly [Loaded, Loaded], shift: readonly [number, number, number]): void {
    const names = this.selects.map((select) => select.selectedOptions[0]?.textContent ?? "");
    const canvases = ["Left", "Right"].map((side, at) =>
      el("canvas", { tabindex: 0, role: "img", "aria-label": `${side}: the models of ${names[at]} in 3D. Both views move together. The list below leads to every difference.` }),
    );
    this.stage.hidden = false;
    this.stage.replaceChildren(
      ...canvases.map((canvas, at) => el("figure", {}, el("figcaption", {}, names[at] ?? ""), el("div", { class: "stage3d" }, canvas))),
    );
    try {
      canvases.forEach((canvas, at) => {
        const scene = new ModelScene(canvas, (id) => this.open(id, at));
        this.scenes[at] = scene;
        scene.add(loaded[at]?.batches ?? []);
        scene.finish();
      });
    } catch {
      this.stage.replaceChildren(warningNotice("This browser cannot draw in 3D (WebGL is missing or switched off). The list still works."));
      return;
    }
    const [left, right] = this.scenes;
    if (left === null || right === null) return;
    for (const [scene, side] of [[left, "old"], [right, "new"]] as const) {
      const colours = new Map(this.found.map((pair) => [pair[side]?.id, CHANGES[pair.change].colour]));
      scene.models.colourBy((id) => colours.get(id) ?? null);
    }
    // the frames differ by a shift: the cameras differ by it, too
    const [x, y, z] = shift;
    const by = { x, y, z };
    const toRight: OnMove = (position, target) => right.camera.look(position.clone().sub(by), target.clone().sub(by));
    const toLeft: OnMove = (position, target) => left.camera.look(position.clone().add(by), target.clone().add(by));
    // an empty side has no view of its own
    const [first, second] = loaded[0].batches.length > 0 ? [left, toRight] : [right, toLeft];
    first.camera.watch(second, true);
    left.camera.watch(toRight);
    right.camera.watch(toLeft);
    canvases.forEach((canvas) => (canvas.dataset["ready"] = "true"));
  }

  // --- the list

  private fill(): void {
    const counts = countOf(this.found.map(({ change }) => change));
    this.legend.hidden = this.explanation.hidden = false;
    this.legend.replaceChildren(
      ...(Object.keys(CHANGES) as Change[]).filter((change) => counts.has(change)).map((change) => {
        const { label, colour, words } = CHANGES[change];
        const show = (on: boolean): void => {
          if (on) this.hidden.delete(change);
          else this.hidden.add(change);
          this.more = STEP;
          this.rows();
        };
        const tick = new Tick(label, show, [colourSwatch(colour)], { class: "legend-row", title: words });
        tick.set(!this.hidden.has(change), counts.get(change) ?? 0);
        return tick.row;
      }),
    );
    this.rows();
  }

  private rows(): void {
    const listed = this.found.filter(({ change }) => !this.hidden.has(change));
    if (listed.length === 0) {
      const isSame = this.found.every(({ change }) => change === "same");
      this.list.replaceChildren(nothing(this.found.length === 0 ? "Neither run has a building." : isSame ? "No building differs above the limits." : "No building is of the chosen kinds."));
      return;
    }
    const rest = listed.length - Math.min(this.more, listed.length);
    const showMore = (): void => {
      const first = this.more;
      this.more += STEP;
      this.rows();
      this.list.querySelectorAll<HTMLElement>("tbody a")[first]?.focus();
    };
    const further = button(`Show ${count(Math.min(rest, STEP))} more of ${count(rest)}`, showMore, { class: "quiet wide", hidden: rest === 0 });
    const isChosen = (pair: Pair): Properties => ({ "aria-current": idOf(pair) === this.selected ? "true" : null });
    refill(this.list, table("Differences", this.columns, listed.slice(0, this.more), isChosen), further);
  }

  // --- the selection

  /** A click on a model: it changes the address, and the view follows the address. */
  private open(id: string | null, side: number): void {
    const pair = this.found.find(({ old, new: now }) => (side === 0 ? old : now)?.id === id);
    const hash = this.address(id === null ? null : (pair?.new?.id ?? id));
    if (location.hash === hash) return; // no address to follow
    this.fromScene = true;
    location.hash = hash;
  }

  private fromScene = false;

  private select(): void {
    const pair = this.selected === null ? undefined : this.found.find((one) => idOf(one) === this.selected);
    const [left, right] = this.scenes;
    const fly = !this.fromScene;
    this.fromScene = false;
    const [old, now] = [pair?.old?.id ?? null, pair?.new?.id ?? null];
    if (pair !== undefined && fly) this.stage.scrollIntoView({ block: "nearest" }); // on narrow screens it does not stay in view
    // one of the cameras leads
    const leads = now !== null && right?.models.has(now) === true ? right : left;
    left?.select(old, fly && leads === left);
    right?.select(now, fly && leads === right);
    if (!this.legend.hidden) this.rows();
  }
}

async function read({ job, method }: Side, signal: AbortSignal): Promise<Loaded> {
  const objects = new RunObjects(pathOfJob(job), method);
  await objects.readReport(signal);
  const batches: Batch[] = [];
  const take = (read: Gathered): void => {
    objects.add(read.listed);
    batches.push(...read.batches);
  };
  await objects.readModels(null, take, signal);
  return { objects, batches };
}

/** From the origin of the left side to that of the right one, in metres. */
function shiftOf(left: Loaded, right: Loaded): [number, number, number] {
  const [from, to] = [originInMetres(left.objects.frame), originInMetres(right.objects.frame)];
  return [to[0] - from[0], to[1] - from[1], to[2] - from[2]];
}

function placed({ objects, batches }: Loaded, [x, y]: readonly number[]): Placed[] {
  const plans = new Map<string, [number, number, number, number]>();
  for (const { listed, boxes } of batches) {
    listed.forEach(({ id }, n) => {
      const [west, south, , east, north] = boxes.subarray(6 * n, 6 * n + 6);
      plans.set(id, [west + (x ?? 0), south + (y ?? 0), east + (x ?? 0), north + (y ?? 0)]);
    });
  }
  return objects.listed.map((one) => ({ listed: one, plan: plans.get(one.id) ?? null }));
}

const idOf = ({ old, new: now }: Pair): string => (now ?? old)?.id ?? "";

/** Differences first, the largest of each kind first. */
function sorted(found: Pair[]): Pair[] {
  const order = Object.keys(CHANGES);
  const size = ({ old, new: now }: Pair): number => Math.max(old?.figures.area ?? 0, now?.figures.area ?? 0);
  return [...found].sort((a, b) => order.indexOf(a.change) - order.indexOf(b.change) || size(b) - size(a));
}

function figures(one: Listed | null): string {
  if (one === null) return "–";
  const parts = [CATEGORIES[one.category].label, figureWords("height", one.figures), figureWords("area", one.figures)];
  return parts.filter((part) => part !== null).join(" · ");
}
