// Control points: a click on the map makes one, its coordinates are typed; the server fits, and saves when asked.

import "leaflet/dist/leaflet.css";
import "./viewer.css";
import L from "leaflet";
import { toPoint, type Point } from "./coordinates";
import { find, listenToKeys, make } from "./dom";
import { ReferencePane, type Place, type ReferenceMap } from "./reference";
import { clamp, imageMap, inside, placed, post, served, showImage, type Served } from "./editor";

interface MarkedPoint {
  x_px: number;
  y_px: number;
  coordinates: string;
}

interface MarkedPoints {
  points: MarkedPoint[];
  order: string;
  epsg: number | null;
}

interface Fit {
  text: string;
  scale: string;
  residuals: { residual_m: number; left_out_m: number | null }[];
}

interface Row {
  at: Point;
  marker: L.Marker;
  element: HTMLTableRowElement;
  coordinates: HTMLInputElement;
  residual: HTMLTableCellElement;
  leftOut: HTMLTableCellElement;
}

const PAUSE_MS = 200; // of typing or moving, before the fit is asked for

class Georeferencer {
  private readonly map: L.Map;
  private rows: Row[] = [];
  private readonly body = find("points").querySelector("tbody")!;
  private readonly order = find<HTMLSelectElement>("order");
  private readonly epsg = find<HTMLInputElement>("epsg");
  private readonly save = find<HTMLButtonElement>("save");
  private timer = 0;
  private asked = 0; // answers to earlier questions are not shown
  private selected: Row | null = null;
  private places: (Place | null)[] = [];
  private readonly reference: ReferencePane | null;

  constructor(private readonly data: Served & { before: MarkedPoints; map: ReferenceMap | null }) {
    this.reference = data.map && new ReferencePane(data.map, this.choose, this.replace);
    this.map = imageMap(data);
    showImage(this.map, data, 0);
    this.order.value = data.before.order;
    this.epsg.value = data.before.epsg === null ? "" : String(data.before.epsg);
    for (const { x_px: x, y_px: y, coordinates } of data.before.points) this.add({ x, y }, coordinates);
    this.listen();
    this.changed();
    find("saved").textContent = this.rows.length ? "As saved before" : "Nothing saved yet";
  }

  // -- points ----------------------------------------------------------------------------------------------------------

  private add(at: Point, text: string): Row {
    const row: Row = {
      at,
      marker: L.marker(placed(at), { draggable: true, autoPan: true, icon: L.divIcon({ className: "point" }) }),
      element: make("tr"),
      coordinates: make("input", { type: "text", inputmode: "text", autocomplete: "off", spellcheck: "false" }),
      residual: make("td"),
      leftOut: make("td"),
    };
    row.coordinates.value = text;
    this.rows.push(row);
    row.marker.addTo(this.map);
    this.lay(row);
    this.listenTo(row);
    this.number();
    return row;
  }

  private lay(row: Row): void {
    const remove = make("button", { type: "button", class: "remove" }, "×");
    remove.addEventListener("click", () => this.remove(row));
    row.element.append(
      make("th", { scope: "row" }),
      make("td", {}, row.coordinates),
      row.residual,
      row.leftOut,
      make("td", {}, remove),
    );
    this.body.append(row.element);
  }

  private listenTo(row: Row): void {
    row.coordinates.addEventListener("input", () => this.changed());
    row.coordinates.addEventListener("focus", () => this.select(row));
    row.marker.on("drag", () => this.move(row, toPoint(row.marker.getLatLng())));
    row.marker.on("dragend", () => row.marker.setLatLng(placed(row.at)));
    const element = row.marker.getElement()!;
    element.addEventListener("focus", () => this.select(row));
    element.addEventListener("keydown", (event) => this.key(row, event));
  }

  private remove(row: Row): void {
    row.marker.remove();
    row.element.remove();
    this.rows = this.rows.filter((other) => other !== row);
    if (this.selected === row) this.selected = null;
    this.number();
    this.changed();
    (this.rows.at(-1)?.coordinates ?? this.map.getContainer()).focus();
  }

  private move(row: Row, to: Point): void {
    row.at = clamp(this.data, to);
    this.changed();
  }

  private select(row: Row): void {
    this.selected = row;
    this.reference?.show(this.places, this.rows.indexOf(row));
    for (const other of this.rows) {
      other.marker.getElement()!.classList.toggle("selected", other === row);
      other.element.classList.toggle("selected", other === row);
    }
  }

  /** Points are numbered as they stand in the table. */
  private number(): void {
    this.rows.forEach((row, k) => {
      const name = `Point ${k + 1}`;
      const element = row.marker.getElement()!;
      element.setAttribute("aria-label", `${name}; arrow keys move it, Delete removes it`);
      element.dataset.number = String(k + 1);
      row.element.querySelector("th")!.textContent = String(k + 1);
      row.element.querySelector("button")!.setAttribute("aria-label", `Remove ${name.toLowerCase()}`);
      row.coordinates.setAttribute("aria-label", `Coordinates of ${name.toLowerCase()}`);
    });
  }

  // -- the user's own map ----------------------------------------------------------------------------------------------

  /** A place was clicked: it is the selected point's, else that of the first without coordinates. */
  private readonly choose = (place: Place): void => {
    const row = this.selected ?? this.rows.find(({ coordinates }) => coordinates.value.trim() === "");
    if (row) void this.place(row, place);
    else this.complain("Click the point in the run's picture first, then the same place on the map");
  };

  private readonly replace = (number: number, place: Place): void => {
    const row = this.rows[number];
    if (row) void this.place(row, place);
  };

  private async place(row: Row, [longitude, latitude]: Place): Promise<void> {
    const { order, epsg } = this.content([]);
    try {
      const asked = { longitude, latitude, order, epsg };
      row.coordinates.value = (await post<{ coordinates: string }>(this.data, "coordinates", asked)).coordinates;
      this.select(row);
      this.changed();
    } catch (error) {
      this.complain((error as Error).message);
    }
  }

  /** Markers on it where the coordinates are, typed or clicked. */
  private async showPlaces(): Promise<void> {
    if (!this.reference) return;
    const { rows } = this;
    const found = await post<{ places: (Place | null)[] }>(this.data, "places", this.content(rows));
    if (rows !== this.rows || found.places.length !== rows.length) return; // changed meanwhile
    this.places = found.places;
    this.reference.show(this.places, this.selected ? rows.indexOf(this.selected) : -1);
  }

  private complain(problem: string): void {
    find("problem").textContent = problem;
    find("problem").hidden = problem === "";
  }

  // -- the fit ---------------------------------------------------------------------------------------------------------

  private changed(): void {
    find("points").hidden = this.rows.length === 0;
    find("epsg-label").hidden = this.order.value !== "x_y";
    for (const { coordinates } of this.rows) {
      coordinates.placeholder = this.order.selectedOptions[0]!.text.replace(/ (of|\().*/, "");
    }
    find("saved").textContent = "Not saved";
    find("notes").replaceChildren();
    window.clearTimeout(this.timer);
    if (!this.rows.length && !this.asked) return; // nothing was fitted yet that would have to be cleared
    this.timer = window.setTimeout(() => {
      void this.fit();
      this.showPlaces().catch((error: Error) => this.complain(error.message));
    }, PAUSE_MS);
  }

  /** Of the points that have coordinates. */
  private async fit(): Promise<void> {
    const known = this.rows.filter((row) => row.coordinates.value.trim() !== "");
    const number = ++this.asked;
    if (known.length === 0) return this.show(known, null, "");
    try {
      const fit = await post<Fit>(this.data, "fit", this.content(known));
      if (number === this.asked) this.show(known, fit, "");
    } catch (error) {
      if (number === this.asked) this.show(known, null, (error as Error).message);
    }
  }

  private content(rows: Row[]): MarkedPoints {
    return {
      points: rows.map(({ at, coordinates }) => ({ x_px: at.x, y_px: at.y, coordinates: coordinates.value })),
      order: this.order.value,
      epsg: this.order.value === "x_y" && this.epsg.value ? Number(this.epsg.value) : null,
    };
  }

  private show(rows: Row[], fit: Fit | null, problem: string): void {
    for (const row of this.rows) {
      const errors = fit?.residuals[rows.indexOf(row)];
      row.residual.textContent = errors?.residual_m.toFixed(2) ?? "";
      row.leftOut.textContent = errors?.left_out_m?.toFixed(2) ?? "";
    }
    find("fit").textContent = fit?.text ?? "";
    find("scale").textContent = fit?.scale ?? "";
    this.complain(problem);
  }

  private async saveAll(): Promise<void> {
    window.clearTimeout(this.timer);
    const { rows } = this;
    const number = ++this.asked;
    this.save.disabled = true;
    find("saved").textContent = "Saving: maps, exports and the page are made again";
    try {
      const done = await post<Fit & { notes: string[] }>(this.data, "save", this.content(rows));
      if (number !== this.asked) return; // changed meanwhile
      this.show(rows, done, "");
      find("saved").textContent = `Saved: ${rows.length} control points; maps, exports and the run's page follow them`;
      find("notes").replaceChildren(...done.notes.map((note) => make("li", {}, note)));
    } catch (error) {
      find("saved").textContent = "NOT saved";
      this.show(rows, null, (error as Error).message);
    } finally {
      this.save.disabled = false;
    }
  }

  // -- controls --------------------------------------------------------------------------------------------------------

  private listen(): void {
    this.map.on("click", (event) => this.mark(toPoint(event.latlng)));
    this.order.addEventListener("change", () => this.changed());
    this.epsg.addEventListener("input", () => this.changed());
    this.save.addEventListener("click", () => void this.saveAll());
    listenToKeys(this.map.getContainer(), { Enter: () => this.mark(toPoint(this.map.getCenter())) });
  }

  private mark(at: Point): void {
    if (!inside(this.data, at)) return;
    const row = this.add(at, "");
    this.changed();
    row.coordinates.focus();
  }

  private key(row: Row, event: KeyboardEvent): void {
    const step = event.shiftKey ? 5 : 0.5;
    const [dx, dy] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key] ?? [0, 0];
    if (event.key === "Delete" || event.key === "Backspace") this.remove(row);
    else if (event.key === "Enter") row.coordinates.focus();
    else if (dx || dy) {
      this.move(row, { x: row.at.x + dx! * step, y: row.at.y + dy! * step });
      row.marker.setLatLng(placed(row.at));
    } else return;
    event.preventDefault();
    event.stopPropagation();
  }
}

new Georeferencer(served());
