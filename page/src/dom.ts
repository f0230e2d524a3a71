// Elements, made and found.

export function find<T extends HTMLElement>(id: string): T {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no #${id}`);
  return found as T;
}

type Child = Node | string;

/** An element with attributes and children; text is text, never markup. */
export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Record<string, string> = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** A table of labels and values. */
export function pairs(rows: [string, Child][]): HTMLTableElement {
  const table = make("table", { class: "pairs" });
  for (const [label, value] of rows) table.append(make("tr", {}, make("th", { scope: "row" }, label), make("td", {}, value)));
  return table;
}

/** A table with a head. */
export function grid(head: string[], rows: Child[][]): HTMLTableElement {
  const cells = (tag: "th" | "td", row: Child[]) => row.map((cell) => make(tag, tag === "th" ? { scope: "col" } : {}, cell));
  return make(
    "table",
    { class: "grid" },
    make("thead", {}, make("tr", {}, ...cells("th", head))),
    make("tbody", {}, ...rows.map((row) => make("tr", {}, ...cells("td", row)))),
  );
}

/** Keys pressed on a map that has the focus; its middle, where they act, is marked as long as no pointer is used. */
export function listenToKeys(container: HTMLElement, acts: Record<string, () => void>): void {
  container.addEventListener("pointerdown", () => container.classList.remove("by-keyboard"));
  container.addEventListener("keydown", (event) => {
    if (event.target !== container) return;
    container.classList.add("by-keyboard");
    const act = acts[event.key];
    if (act === undefined) return;
    act();
    event.preventDefault();
  });
}

export interface Surface {
  canvas: HTMLCanvasElement;
  context: CanvasRenderingContext2D;
}

/** A canvas of so many CSS pixels, sharp on any screen. */
export function surface(width: number, height: number, label: string): Surface {
  const scale = window.devicePixelRatio || 1;
  const canvas = make("canvas", { role: "img", "aria-label": label });
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  canvas.style.width = `${width}px`;
  canvas.style.height = `${height}px`;
  const context = canvas.getContext("2d")!;
  context.scale(scale, scale);
  return { canvas, context };
}

export function ink(name: "--ink" | "--faint" | "--edge" | "--accent" | "--card"): string {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** A small arrow that points the way of `directionRad` on the screen. */
export function arrow(directionRad: number): HTMLSpanElement {
  const span = make("span", { class: "arrow", "aria-hidden": "true" }, "➜");
  span.style.transform = `rotate(${directionRad}rad)`;
  return span;
}
