import { getJson, pathOfJob, sendJson } from "../api/requests";
import type { InputDescription, StatusInfo } from "../api/types";
import { openForm } from "../page/dialogs";
import { el } from "../page/elements";
import { announce } from "../page/notices";
import { jobsChanged } from "../page/view";
import { changed, inputFields, isFirst } from "../submit/input_fields";
import { titleOf } from "./job_words";
import { changes, flat } from "./settings_changes";
import { SettingsEditor } from "./settings_editor";

/** Ask for changes of a job, then start a new one; the page goes to it. The inputs are those that the process describes. */
export async function retry(listed: StatusInfo): Promise<void> {
  // lists leave the request out
  const job = listed.request === undefined ? await getJson<StatusInfo>(pathOfJob(listed.jobID)) : listed;
  const process = job.processID ?? "reconstruct";
  const { inputs } = await getJson<{ inputs: Record<string, InputDescription> }>(`processes/${encodeURIComponent(process)}`);
  const before = job.request?.inputs ?? {};
  const settings = (before["settings"] ?? {}) as Record<string, unknown>;
  const fields = inputFields(inputs, { ...settings, ...before });
  const own = new Map([...flat(settings)].filter(([name]) => !fields.has(name)));
  const schema = inputs["settings"]?.schema;
  const editor = schema === undefined ? null : new SettingsEditor(schema, own, new Set(fields.keys()));
  const shown = (first: boolean): HTMLElement[] => [...fields].filter(([name]) => isFirst(name) === first).map(([, { element }]) => element);
  const more = shown(false);
  openForm("Try again", {
    content: [
      el("p", {}, `A new job with the files of “${titleOf(job)}”. What you do not change stays as it was.`),
      ...shown(true),
      editor?.element ?? null,
      more.length === 0 ? null : el("details", { class: "options" }, el("summary", {}, "More"), ...more),
    ],
    send: "Start the new job",
    act: async () => {
      const given = changed(fields);
      const set = editor === null ? {} : changes(editor.before, editor.value());
      if (Object.keys(set).length > 0) given["settings"] = set;
      const response = await sendJson("POST", `${pathOfJob(job.jobID)}/retry`, { inputs: given });
      const { jobID } = (await response.json()) as StatusInfo;
      announce("The new job is submitted.");
      jobsChanged();
      location.hash = `#/jobs/${jobID}`;
    },
  });
}
