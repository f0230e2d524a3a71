// Two tabs, as screen readers and keyboards know them.

import { find } from "./dom";

const NAMES = ["map", "summary"] as const;
export type Tab = (typeof NAMES)[number];

export function showTab(tab: Tab): void {
  for (const name of NAMES) {
    const button = find(`tab-${name}`);
    button.setAttribute("aria-selected", String(name === tab));
    button.tabIndex = name === tab ? 0 : -1;
    find(`${name}-panel`).hidden = name !== tab;
  }
  document.body.dataset.tab = tab;
}

export function listenToTabs(chosen: (tab: Tab) => void): void {
  for (const name of NAMES) {
    const button = find(`tab-${name}`);
    button.addEventListener("click", () => chosen(name));
    button.addEventListener("keydown", (event) => {
      if (!["ArrowLeft", "ArrowRight"].includes(event.key)) return;
      const other = name === "map" ? "summary" : "map";
      chosen(other);
      find(`tab-${other}`).focus();
    });
  }
}
