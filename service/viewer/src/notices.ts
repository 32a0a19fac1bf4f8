import { Problem } from "./api";
import { el } from "./elements";

/** An error as the service reported it, with the fix. */
export function problemNotice(problem: Problem, again?: () => void): HTMLElement {
  return el(
    "div",
    { class: "notice notice-error", role: "alert" },
    el("strong", {}, problem.title),
    problem.detail === "" ? null : el("p", {}, problem.detail),
    problem.remedy === "" ? null : el("p", { class: "remedy" }, problem.remedy),
    again === undefined ? null : el("button", { type: "button", onclick: again }, "Try again"),
  );
}

/** Something odd but usable. */
export function warningNotice(...messages: string[]): HTMLElement {
  return el(
    "div",
    { class: "notice notice-warning" },
    ...(messages.length === 1 ? messages.map((m) => el("p", {}, m)) : [el("ul", {}, ...messages.map((m) => el("li", {}, m)))]),
  );
}

/** Anything that was thrown, as a problem. */
export function asProblem(error: unknown): Problem {
  if (error instanceof Problem) return error;
  return new Problem(0, "The page could not go on", error instanceof Error ? error.message : String(error), "Reload the page.");
}

/** Says something to those who listen rather than look. */
export function announce(message: string): void {
  const status = document.getElementById("status");
  if (status !== null && status.textContent !== message) status.textContent = message;
}
