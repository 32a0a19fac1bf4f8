/** The page: it shows what the address names. */

import { currentKey, KEY_NEEDED, keepKey, Problem } from "./api/requests";
import { JobList } from "./jobs/job_list";
import { partsOf, placeOf } from "./page/address";
import { openForm, type Opened } from "./page/dialogs";
import { byId, el } from "./page/elements";
import { field } from "./page/form_fields";
import { problemNotice } from "./page/notices";
import { jobsChanged, type View } from "./page/view";
import { showJob } from "./progress/job_view";
import { Submission } from "./submit/submission";
import { hasView, showView } from "./views";
import "./frame.css";

const main = byId("main");
const jobs = new JobList(byId("jobs"));
const submitted = (jobId: string): void => {
  jobsChanged();
  location.hash = `#/jobs/${jobId}`;
};
// files are sent in a way of their own
new Submission(byId("submission"), submitted, (problem) => problem.status === 401 && askForKey(problem));

let shown = "";
let view: View | null = null;

function route(): void {
  const place = placeOf(location.hash);
  const address = partsOf(location.hash);
  const isView = place === null && hasView(address.name);
  jobs.mark(place?.job ?? "");
  document.body.classList.toggle("has-job", place !== null || isView);
  document.body.classList.toggle("has-view", isView);
  for (const link of document.querySelectorAll("nav.places a")) {
    const isHere = isView && link.getAttribute("href") === `#/${address.name}`;
    if (isHere) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  const now = place !== null ? `${place.job} ${place.method ?? ""}` : isView ? `/${[address.name, ...address.rest].join("/")}` : "";
  if (now === shown && view !== null) {
    view.follow(address); // only the building or the query changed
    return;
  }
  view?.leave();
  shown = now;
  view = null;
  main.scrollTop = 0;
  if (place !== null) {
    view = showJob(main, place);
  } else if (isView) {
    view = showView(main, address);
  } else {
    document.title = "gablework";
    main.replaceChildren(byId<HTMLTemplateElement>("welcome").content.cloneNode(true));
  }
}

let asking: Opened | null = null;

/** Ask for a key that is missing or refused. */
function askForKey(problem: Problem | null): void {
  if (asking?.element.isConnected === true) return;
  if (problem !== null && currentKey() !== null) {
    problem = new Problem(problem.status, "This key is not valid", "It may be mistyped or revoked.", problem.remedy);
  }
  const key = el("input", { id: "key-field", type: "password", autocomplete: "off", spellcheck: "false" });
  key.value = currentKey() ?? "";
  asking = openForm("Key of this service", {
    content: [
      problem === null ? null : problemNotice(problem),
      field("Your key", key, "It begins with gw_. This tab forgets it when you close it."),
    ],
    send: "Use this key",
    act: async () => {
      keepKey(key.value);
      location.reload();
    },
  });
}

byId("key-button").addEventListener("click", () => askForKey(null));
document.addEventListener(KEY_NEEDED, ({ detail }) => askForKey(detail));
window.addEventListener("hashchange", route);
route();
