import { el } from "./elements";
import { asProblem, report } from "./notices";

/** A view, or a part of one, that looks at the service again and again until it is left. */
export abstract class Watching {
  /** Says why the last look failed. */
  protected readonly note = el("div");
  private calledOff = new AbortController();
  private timer: number | undefined;
  private isLeft = false;

  /** @param refreshMs Pause between two looks. */
  constructor(private readonly refreshMs: number) {}

  leave(): void {
    this.isLeft = true;
    this.stop();
  }

  /**
   * Read what is shown, and show it unless the signal is aborted.
   *
   * @param isAsked False if the clock wants it.
   * @returns Whether it may change by itself: then it is read again.
   */
  protected abstract read(signal: AbortSignal, isAsked: boolean): Promise<boolean>;

  /** Look now, and again later; no longer once it is left: actions may end after that. */
  protected async load(isAsked = true): Promise<void> {
    if (this.isLeft) return;
    this.stop();
    const { signal } = (this.calledOff = new AbortController());
    try {
      const again = await this.read(signal, isAsked);
      if (signal.aborted) return;
      this.note.replaceChildren();
      if (again) this.wait();
    } catch (error) {
      if (signal.aborted) return;
      const problem = asProblem(error);
      // a notice that is drawn anew is read out anew
      if (isAsked || this.note.childElementCount === 0) report(this.note, problem, () => void this.load());
      // what is shown stays; it is looked at again until the service is back
      if (problem.status === 0 && !isAsked) this.wait();
    }
  }

  private wait(): void {
    this.timer = window.setTimeout(() => void this.load(false), this.refreshMs);
  }

  private stop(): void {
    clearTimeout(this.timer);
    this.calledOff.abort();
  }
}
