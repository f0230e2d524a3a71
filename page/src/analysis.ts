// The tab Analysis: the tables of analysis/analysis.json (schemas/analysis.py), their rows over the map.

import { find, grid, make } from "./dom";
import { Unreadable } from "./run";
import { countText, type Units } from "./units";

const MAX_ROWS = 200; // shown of a table

export interface Geometry {
  type: "Point" | "LineString" | "Polygon";
  xy_px: [number, number][];
}

/** A row of a table on the map, its label empty where nothing in the row names it alone; or a name, which has no mark. */
export interface Place {
  geometry: Geometry;
  label: string;
  isName?: true;
}

interface Estimate {
  value: number | null;
  low: number | null;
  high: number | null;
  n: number;
}

type Cell = Estimate | boolean | number | string | null;

interface Row {
  cells: Record<string, Cell>;
  geometry: Geometry | null;
  unknown?: boolean;
}

interface Table {
  name: string;
  section: string;
  title: string;
  note: string;
  columns: { name: string; title: string; unit: string; unknown?: boolean }[];
  rows: Row[];
}

interface Analysis {
  tracks: number;
  seen?: string;
  level: number;
  gsd_known: boolean;
  directions?: string;
  names?: { name: string; x_px: number; y_px: number }[];
  answers?: { question: string; lines: string[] }[];
  tables: Table[];
}

async function loadAnalysis(): Promise<Analysis | null> {
  const response = await fetch("analysis/analysis.json", { cache: "no-cache" });
  if (response.status === 404) return null;
  if (!response.ok) throw new Unreadable(`analysis/analysis.json cannot be read (${response.status})`);
  return response.json();
}

export class AnalysisPanel {
  private loaded: Promise<Analysis | null> | undefined;
  private table = 0;

  constructor(
    private readonly units: Units,
    /** Show these on the map, one of them chosen. */
    private readonly draw: (all: Place[], chosen: Geometry | null) => void,
  ) {}

  /** Fill the panel; read the file the first time. */
  async show(): Promise<void> {
    const started = performance.now();
    this.loaded ??= loadAnalysis();
    const analysis = await this.loaded.catch((error: unknown) => {
      this.loaded = undefined; // asked again the next time
      throw error;
    });
    if (!analysis || !analysis.tables.length) {
      const text = "This run has not been analysed. For lanes, movements and speeds with intervals: velfield analyse RUN, then load this page again.";
      find("analysis-content").replaceChildren(make("p", { class: "note" }, text));
      return;
    }
    this.render(analysis);
    find("analysis-content").dataset.milliseconds = (performance.now() - started).toFixed(1);
  }

  private render(analysis: Analysis): void {
    const whole = analysis.tables[this.table]!;
    const isKnown = ({ unknown }: { unknown?: boolean }): boolean => !unknown;
    const table = { ...whole, rows: whole.rows.filter(isKnown), columns: whole.columns.filter(isKnown) };
    const rows = whole.rows.length - table.rows.length;
    const columns = whole.columns.filter(({ unknown }) => unknown).map(({ title }) => `“${title}”`);
    const leftOut = [...(rows ? [countText(rows, "row")] : []), ...columns];
    const choice = make("select", { id: "table" });
    for (const section of new Set(analysis.tables.map((each) => each.section))) {
      const group = make("optgroup", { label: section });
      analysis.tables.forEach((each, k) => {
        if (each.section === section) group.append(make("option", { value: String(k) }, `${each.title} (${each.rows.length})`));
      });
      choice.append(group);
    }
    choice.value = String(this.table);
    choice.addEventListener("change", () => {
      this.table = Number(choice.value);
      const started = performance.now();
      this.render(analysis);
      find("analysis-content").dataset.milliseconds = (performance.now() - started).toFixed(1);
      find("table").focus();
    });
    const metres = analysis.gsd_known ? "" : " The scale is not known: lengths assume 0.23 m per pixel.";
    const seen = analysis.seen ?? countText(analysis.tracks, "vehicle");
    const about = `${seen}. Grey: ${Math.round(100 * analysis.level)} % interval and n, the number of observations.${metres}`;
    const named = `J0 on the map is junction 0, or crossing 0, in the text. Roads are named by where they lead to (${analysis.directions}).`;
    const names = analysis.names?.length ? [make("p", { class: "note" }, named)] : [];
    const note = make("p", { class: "note" }, table.note);
    const answers = (analysis.answers ?? []).flatMap(({ question, lines }) => [make("dt", {}, question), ...lines.map((line) => make("dd", {}, line))]);
    const content: HTMLElement[] = [make("p", { class: "note" }, about), ...names, make("dl", { class: "answers" }, ...answers), make("label", {}, "Table ", choice), note];
    if (table.rows.length) content.push(this.rows(analysis, table));
    else if (!rows) content.push(make("p", {}, "Nothing of this kind was found."));
    const left = `Not known, and left out here (analysis/analysis.xlsx has all): ${leftOut.join(", ")}.`;
    if (leftOut.length) content.push(make("p", { class: "note" }, left));
    if (table.rows.length > MAX_ROWS) content.push(make("p", { class: "note" }, `and ${table.rows.length - MAX_ROWS} more, in analysis/analysis.json`));
    find("analysis-content").replaceChildren(...content);
    this.draw(places(analysis, table), null);
  }

  private rows(analysis: Analysis, table: Table): HTMLElement {
    const shown = table.rows.slice(0, MAX_ROWS);
    const placed = shown.some(({ geometry }) => geometry);
    const titles = table.columns.map(({ title, unit }) => `${title}${this.shownUnit(unit) && `, ${this.shownUnit(unit)}`}`);
    const element = grid(
      [...(placed ? ["Map"] : []), ...titles],
      shown.map((row, k) => [
        ...(placed ? [this.button(analysis, table, row, k)] : []),
        ...table.columns.map(({ name, unit }) => this.cell(row.cells[name] ?? null, unit)),
      ]),
    );
    const label = `Table ${table.title}`;
    return make("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": label }, element);
  }

  private button(analysis: Analysis, table: Table, row: Row, k: number): HTMLElement | string {
    const { geometry } = row;
    if (!geometry) return "";
    const button = make("button", { type: "button", "aria-label": `Show row ${k + 1} on the map`, class: "place" }, "●");
    button.addEventListener("click", () => this.draw(places(analysis, table), geometry));
    return button;
  }

  /** Speeds are stored in m/s and shown in the chosen unit. */
  private shownUnit(unit: string): string {
    return unit === "m/s" ? this.units.speed : unit;
  }

  private cell(cell: Cell, unit: string): Node | string {
    const text = (value: number): string => {
      const shown = unit === "m/s" ? this.units.fromMetresPerSecond(value) : value;
      return Number.isInteger(shown) ? String(shown) : Math.abs(shown) < 1 ? shown.toFixed(2) : shown.toFixed(1);
    };
    if (cell === null) return "–";
    if (typeof cell === "boolean") return cell ? "yes" : "no";
    if (typeof cell === "string") return cell;
    if (typeof cell === "number") return text(cell);
    if (cell.value === null) return "–";
    const span = make("span", {}, text(cell.value));
    const interval = cell.low !== null && cell.high !== null ? `${text(cell.low)} to ${text(cell.high)}, ` : "";
    span.append(make("span", { class: "error" }, ` ${interval}n = ${cell.n}`));
    return span;
  }
}

/** The names, and the rows of a table that lie on the map, with their first cells as labels where no two rows share one. */
function places({ names }: Analysis, table: Table): Place[] {
  const first = table.columns[0]!.name;
  const labels = table.rows.map(({ cells }) => cells[first] ?? "");
  const named = first !== "junction" && new Set(labels).size === labels.length && labels.every((label) => typeof label !== "object");
  const rows = table.rows.flatMap(({ geometry }, k) => (geometry ? [{ geometry, label: named ? String(labels[k]) : "" }] : []));
  return [...(names ?? []).map(nameOnMap), ...rows];
}

function nameOnMap({ name, x_px, y_px }: { name: string; x_px: number; y_px: number }): Place {
  return { geometry: { type: "Point", xy_px: [[x_px, y_px]] }, label: name, isName: true };
}
