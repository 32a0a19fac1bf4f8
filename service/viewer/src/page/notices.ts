import { Problem } from "../api/requests";
import { inFields } from "../words/fields";
import { el } from "./elements";

/** An error as the service reported it, with the fix. */
export function problemNotice(problem: Problem, again?: () => void): HTMLElement {
  return el(
    "div",
    { class: "notice notice-error", role: "alert" },
    el("strong", {}, problem.title),
    problem.detail === "" ? null : el("p", {}, inFields(problem.detail)),
    problem.remedy === "" ? null : el("p", { class: "remedy" }, problem.remedy),
    again === undefined ? null : el("button", { type: "button", onclick: again }, "Try again"),
  );
}

/** A warning. */
export function warningNotice(...messages: string[]): HTMLElement {
  const words = messages.map(inFields);
  return el(
    "div",
    { class: "notice notice-warning" },
    ...(words.length === 1 ? words.map((m) => el("p", {}, m)) : [el("ul", {}, ...words.map((m) => el("li", {}, m)))]),
  );
}

/** Anything that was thrown, as a problem. */
export function asProblem(error: unknown): Problem {
  if (error instanceof Problem) return error;
  return new Problem(0, "The page failed", error instanceof Error ? error.message : String(error), "Reload the page.");
}

/** Show what was thrown; `again` tries once more what failed. */
export function report(place: HTMLElement, error: unknown, again?: () => void): void {
  place.replaceChildren(problemNotice(asProblem(error), again));
}

/** Announces a text to screen readers. */
export function announce(message: string): void {
  const status = document.getElementById("status");
  if (status !== null && status.textContent !== message) status.textContent = message;
}
