/** The page: it shows what the address names. */

import { placeOf } from "./address";
import { Problem, currentKey, getJson, keepKey } from "./api";
import { byId, el } from "./elements";
import { JobList } from "./job_list";
import { showJob } from "./job_view";
import { problemNotice } from "./notices";
import { Submission } from "./submission";
import { welcome } from "./welcome";

const main = byId("main");
const jobs = new JobList(byId("jobs"), onProblem);
new Submission(byId("submission"), (jobId) => {
  void jobs.refresh();
  location.hash = `#/jobs/${jobId}`;
}, onProblem);

let shown = "";
let leave: () => void = () => undefined;

function route(): void {
  const place = placeOf(location.hash);
  jobs.mark(place?.job ?? "");
  document.body.classList.toggle("has-job", place !== null);
  const run = place === null ? "" : `${place.job} ${place.method ?? ""}`;
  if (run === shown && place !== null) return; // only the building changed: the job's view handles that itself
  leave();
  shown = run;
  if (place === null) {
    document.title = "gablework";
    main.replaceChildren(welcome());
    leave = () => undefined;
    return;
  }
  leave = showJob(main, place, {
    onChange: () => void jobs.refresh(),
    onProblem,
  });
}

/** Ask for a key that is missing or refused; show all other problems where they happened. */
function onProblem(problem: Problem): void {
  if (problem.status === 401) askForKey(problem);
}

const dialog = byId<HTMLDialogElement>("key-dialog");

function askForKey(problem: Problem | null): void {
  if (dialog.open) return;
  if (problem !== null && currentKey() !== null) {
    problem = new Problem(problem.status, "This key is not valid", "It may be mistyped or revoked.", problem.remedy);
  }
  const field = el("input", {
    id: "key-field",
    type: "password",
    autocomplete: "off",
    spellcheck: "false",
    "aria-describedby": "key-hint",
  });
  field.value = currentKey() ?? "";
  const form = el(
    "form",
    { method: "dialog" },
    el("h2", { id: "key-title" }, "Key of this service"),
    problem === null ? null : problemNotice(problem),
    el("label", { for: "key-field" }, "Your key"),
    field,
    el("p", { class: "hint", id: "key-hint" }, "It begins with gw_. This tab forgets it when you close it."),
    el(
      "div",
      { class: "actions" },
      el("button", { type: "button", class: "quiet", onclick: () => dialog.close() }, "Cancel"),
      el("button", { type: "submit", class: "primary" }, "Use this key"),
    ),
  );
  form.addEventListener("submit", () => {
    keepKey(field.value);
    location.reload();
  });
  dialog.replaceChildren(form);
  dialog.showModal();
}

byId("key-button").addEventListener("click", () => askForKey(null));
window.addEventListener("hashchange", route);
route();
void jobs.start();
void getJson("processes/reconstruct").catch((error: unknown) => {
  if (error instanceof Problem) onProblem(error);
});
