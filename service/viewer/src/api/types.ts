/** What the service sends and takes, as far as the page uses it; `openapi.json` has the rest. */

export interface Link {
  href: string;
  rel?: string;
  type?: string;
  title?: string;
}

export type Status = "accepted" | "running" | "successful" | "failed" | "dismissed";

/** What a run found. */
export interface Summary {
  /** Buildings by status: ok, doubtful, fallback, failed. */
  statuses?: Record<string, number>;
}

export interface StatusInfo {
  jobID: string;
  processID?: string;
  status: Status;
  message?: string;
  progress?: number;
  created?: string;
  started?: string;
  finished?: string;
  title?: string;
  stage?: string;
  /** The schedule that made the job. */
  scheduleID?: string;
  links?: Link[];
  /** Kept, whatever its age and size. */
  keep?: boolean;
  /** What was asked for; lists leave it out. */
  request?: { inputs?: Record<string, unknown> };
  summary?: Summary & {
    /** The summary of each run of a comparison, by label. */
    runs?: Record<string, Summary>;
    /** Points by class, of a classification. */
    classes?: Record<string, number>;
  };
  exception?: { type?: string; title?: string; detail?: string };
}

export interface JobEvent {
  kind: string;
  /** The new status; only for kind `status`. */
  status?: Status;
  stage: string;
  done: number;
  total: number;
  progress: number;
  message: string;
}

export interface Feature {
  type: "Feature";
  id?: string;
  geometry: { type: string; coordinates: unknown } | null;
  properties: Record<string, unknown>;
}

/** An entry of `/decisions`. */
export interface Decision {
  step: number;
  kind: "check" | "form" | "level";
  name: string;
  outcome: string;
  detail: string;
  value?: number;
  limit?: number;
  n_faces?: number;
  n_planes?: number;
  levelled_share?: number;
  explained_share?: number;
  bic_margin?: number;
  validity_codes?: number[];
}

/** Metres per unit of the coordinates of a run. */
export interface Units {
  horizontal_unit_m?: number | null;
  /** Metres per unit of the elevations in tables. */
  vertical_unit_m?: number | null;
  /** The same for CityJSON; older reports lack it, where both are equal. */
  cityjson_vertical_unit_m?: number | null;
}

/** The entry `crs` of a report. */
export interface Crs extends Units {
  name?: string | null;
  wkt?: string | null;
  to_wgs84?: string | null;
}

/** The part of the report that the page reads. */
export interface RunReport {
  crs?: Crs;
  engine_version?: string;
  method?: string;
  settings_hash?: string;
  counts?: Record<string, number>;
  timings_s?: Record<string, number>;
  warnings?: string[];
  /** Why the result is empty; shown before all figures. */
  headline?: string;
}

/** An upload with the facts of its header. */
export type Preflight = Record<string, unknown>;

export interface UploadInfo {
  /** Its reference in the inputs of an execution. */
  href: string;
  preflight: Preflight;
}

export interface ScheduleRun {
  number: number;
  trigger: "clock" | "hand";
  outcome: string;
  slot?: string;
  slots: number;
  moreSlots?: boolean;
  jobID?: string;
  at: string;
  message: string;
}

export interface Schedule {
  scheduleID: string;
  version: number;
  title?: string;
  state: "active" | "paused";
  cron: string;
  timeZone: string;
  missed: string;
  overlap: string;
  processID: string;
  execute?: { inputs?: Record<string, unknown> };
  nextTimes: string[];
  waiting?: string;
  lastRun?: ScheduleRun;
  counts: Record<string, number>;
}

export interface Webhook {
  webhookID: string;
  url: string;
  events: string[];
  description?: string;
  enabled: boolean;
  disabledReason?: string;
  created: string;
}

export interface EventKind {
  type: string;
  title: string;
  isDefault: boolean;
}

export interface Secret {
  secret: string;
}

export interface Delivery {
  deliveryID: string;
  jobID: string;
  webhookID?: string;
  url: string;
  type: string;
  title: string;
  state: string;
  reason?: string;
  created: string;
  nextAttempt?: string;
  finished?: string;
  attemptCount: number;
  attempts?: { number: number; at: string; durationMilliseconds?: number; status?: number; error?: string }[];
  body?: string;
}

/** A setting as the process describes it. */
export interface SettingSchema {
  description?: string;
  default?: unknown;
  type?: string;
  enum?: string[];
  minimum?: number;
  maximum?: number;
  properties?: Record<string, SettingSchema>;
}

export interface InputDescription {
  title?: string;
  description?: string;
  schema: SettingSchema & { items?: SettingSchema };
}
