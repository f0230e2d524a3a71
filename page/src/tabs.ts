// Tabs, as screen readers and keyboards know them.

import { find } from "./dom";

const NAMES = ["map", "analysis", "summary"] as const;
export type Tab = (typeof NAMES)[number];

export function showTab(tab: Tab): void {
  for (const name of NAMES) {
    const button = find(`tab-${name}`);
    button.setAttribute("aria-selected", String(name === tab));
    button.tabIndex = name === tab ? 0 : -1;
  }
  find("map-panel").hidden = tab === "summary"; // both tabs of the map have it
  find("side").hidden = tab !== "map";
  find("analysis").hidden = tab !== "analysis";
  find("summary-panel").hidden = tab !== "summary";
  document.body.dataset.tab = tab;
}

export function listenToTabs(chosen: (tab: Tab) => void): void {
  for (const name of NAMES) {
    const button = find(`tab-${name}`);
    button.addEventListener("click", () => chosen(name));
    button.addEventListener("keydown", (event) => {
      if (!["ArrowLeft", "ArrowRight"].includes(event.key)) return;
      const step = event.key === "ArrowRight" ? 1 : NAMES.length - 1;
      const other = NAMES[(NAMES.indexOf(name) + step) % NAMES.length]!;
      chosen(other);
      find(`tab-${other}`).focus();
    });
  }
}
