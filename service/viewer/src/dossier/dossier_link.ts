/** The way to a building's dossier: its address opens it, and any other address closes it. The rest is loaded then. */

import type { Run } from "../api/requests";
import { placeOf } from "../page/address";
import { el } from "../page/elements";

const DOSSIER = /\/dossier(?=\?|$)/;

/** Whether an address names a dossier: `#/jobs/<job>/…/buildings/<building>/dossier`, then a query if there is one. */
export function isDossier(hash: string): boolean {
  return DOSSIER.test(hash) && placeOf(hash)?.building != null;
}

/** The address of the dossier of the building that an address names, and back; all else stays. */
export function dossierAddress(hash: string, open: boolean): string {
  const plain = hash.replace(DOSSIER, "");
  return open ? plain.replace(/(?=\?)|$/, "/dossier") : plain;
}

/** The link to the dossier of the building that the address names. */
export function dossierLink(): HTMLElement {
  const link = el("a", { class: "dossier-link", href: dossierAddress(location.hash, true) }, "Dossier");
  // the rest of the address may have changed meanwhile
  link.addEventListener("click", () => (link.href = dossierAddress(location.hash, true)));
  return link;
}

/** Open and close the dossier of a building as the address says, until the signal is aborted. */
export function followDossier(run: Run, buildingId: string, signal: AbortSignal): void {
  let close: (() => void) | null = null;
  const isWanted = (): boolean =>
    !signal.aborted && isDossier(location.hash) && placeOf(location.hash)?.building === buildingId;
  const closed = (): void => {
    close = null;
    if (isWanted()) location.hash = dossierAddress(location.hash, false);
  };
  const follow = (): void => {
    if (!isWanted()) {
      close?.();
      close = null;
      return;
    }
    void import("./dossier").then(({ openDossier }) => {
      if (isWanted() && close === null) close = openDossier(run, buildingId, closed);
    });
  };
  window.addEventListener("hashchange", follow, { signal });
  signal.addEventListener("abort", follow);
  follow();
}
