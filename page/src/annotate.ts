// Marking cars: a drag along a car makes one, a click selects one. Every change is saved at once.

import "leaflet/dist/leaflet.css";
import "./viewer.css";
import L from "leaflet";
import { corners, carFromEnds, contains, DEFAULT_RATIO, type Car } from "./cars";
import { find } from "./dom";
import { toLatLng, toPoint, type Point } from "./coordinates";
import { imageMap, inside, post, served, showImage, type Served } from "./editor";
import { countText } from "./units";

interface ServerData extends Served {
  labels: string;
  names: string[];
  marks: { frames: string[]; cars: Car[] };
  /** Of frames that are not labelled: what they begin with. */
  found: Car[];
}

const MIN_DRAG_PX = 4; // screen px: a shorter drag is a click

class Annotator {
  private readonly map: L.Map;
  private readonly drawn = L.layerGroup();
  private image: L.ImageOverlay | undefined;
  private frame = 0;
  private cars: Car[];
  private readonly empty: Set<string>; // frames marked as empty
  private readonly touched: Set<string>; // frames that are or were labelled
  private readonly offered: Set<string>; // frames whose marks are the run's: no labels until one is changed, or all confirmed
  private selected: Car | null = null;
  private from: L.LatLng | null = null;
  private ratio = DEFAULT_RATIO;
  private saving: Promise<void> = Promise.resolve();

  constructor(private readonly data: ServerData) {
    this.cars = [...data.marks.cars, ...data.found];
    this.offered = new Set(data.found.map(({ frame }) => frame));
    this.empty = new Set(data.marks.frames.filter((name) => !this.cars.some((car) => car.frame === name)));
    this.touched = new Set(data.marks.frames);
    this.map = imageMap(data, { dragging: false, keyboard: false });
    this.drawn.addTo(this.map);
    for (const id of ["previous", "next"]) find(id).hidden = data.names.length === 1;
    this.listen();
    this.show(0);
  }

  private get name(): string {
    return this.data.names[this.frame]!;
  }

  // -- what is shown ---------------------------------------------------------------------------------------------------

  private show(frame: number): void {
    this.frame = Math.min(Math.max(frame, 0), this.data.names.length - 1);
    this.selected = null;
    this.image?.remove();
    this.image = showImage(this.map, this.data, this.frame);
    find("frame").textContent = `Frame ${this.frame + 1} of ${this.data.names.length}: ${this.name}`;
    find<HTMLButtonElement>("previous").disabled = this.frame === 0;
    find<HTMLButtonElement>("next").disabled = this.frame === this.data.names.length - 1;
    this.draw();
  }

  private draw(): void {
    this.drawn.clearLayers();
    const here = this.cars.filter((car) => car.frame === this.name);
    for (const car of here) {
      const colour = car === this.selected ? "#ffd400" : "#00e5ff";
      const shape = corners(car).map(({ x, y }) => toLatLng(x, y));
      this.drawn.addLayer(L.polygon(shape, { color: "#000", weight: 4, fill: false, interactive: false }));
      this.drawn.addLayer(L.polygon(shape, { color: colour, weight: 2, fillOpacity: 0.12, interactive: false }));
    }
    const none = find<HTMLButtonElement>("none");
    none.setAttribute("aria-pressed", String(this.empty.has(this.name)));
    none.disabled = here.length > 0;
    find<HTMLButtonElement>("remove").disabled = this.selected === null;
    const width = find<HTMLInputElement>("width");
    width.disabled = this.selected === null;
    width.value = this.selected?.width_px?.toFixed(1) ?? "";
    const offered = this.offered.has(this.name);
    find("confirm").hidden = !offered;
    const by = offered ? ", found by the run and not saved: remove what is no car, add what is missing" : "";
    this.showStatus(`${countText(here.length, "car")} in this frame${by}`);
  }

  private showStatus(text: string): void {
    find("saved").textContent = text;
  }

  // -- marks -----------------------------------------------------------------------------------------------------------

  private pressed(event: PointerEvent): void {
    const control = event.target instanceof Element && event.target.closest(".leaflet-control");
    const draws = event.isPrimary && event.button === 0 && !control && !this.map.dragging.enabled();
    this.from = draws ? this.map.mouseEventToLatLng(event) : null; // a second finger zooms
  }

  private released(event: PointerEvent): void {
    const { from } = this;
    this.from = null;
    if (!from) return;
    const to = this.map.mouseEventToLatLng(event);
    const apart = this.map.latLngToContainerPoint(from).distanceTo(this.map.latLngToContainerPoint(to));
    if (apart < MIN_DRAG_PX) this.select(toPoint(to));
    else this.add(toPoint(from), toPoint(to));
  }

  private select(point: Point): void {
    this.selected = this.cars.find((car) => car.frame === this.name && contains(car, point)) ?? null;
    this.draw();
  }

  private add(from: Point, to: Point): void {
    const car = carFromEnds(this.name, from, to, this.ratio);
    if (!this.inside(car)) return;
    this.cars.push(car);
    this.selected = car;
    this.changed();
  }

  private inside({ x_px: x, y_px: y }: Car): boolean {
    return inside(this.data, { x, y });
  }

  private remove(): void {
    this.cars = this.cars.filter((car) => car !== this.selected);
    this.selected = null;
    this.changed();
  }

  private widen(width: number): void {
    const car = this.selected;
    if (!car || !(width >= 1)) return;
    car.width_px = width;
    if (car.length_px) this.ratio = width / car.length_px; // the next car gets the same ratio
    this.changed();
  }

  private shift(dx: number, dy: number): void {
    const car = this.selected;
    if (!car || !this.inside({ ...car, x_px: car.x_px + dx, y_px: car.y_px + dy })) return;
    car.x_px += dx;
    car.y_px += dy;
    this.changed();
  }

  // -- saving ----------------------------------------------------------------------------------------------------------

  private changed(): void {
    this.offered.delete(this.name);
    if (this.cars.some((car) => car.frame === this.name)) this.empty.delete(this.name);
    this.draw();
    this.saving = this.saving.then(() => this.save()).catch((error) => this.showStatus(`NOT saved: ${error.message}`));
  }

  private async save(): Promise<void> {
    const labels = this.cars.filter((car) => !this.offered.has(car.frame));
    const labelled = new Set([...this.empty, ...labels.map((car) => car.frame)]);
    labelled.forEach((name) => this.touched.add(name));
    const frames = this.data.names.filter((name) => labelled.has(name));
    // A frame that lost its last car, and is not marked as empty, is no longer labelled.
    const cleared = [...this.touched].filter((name) => !labelled.has(name));
    const { cars } = await post<{ cars: number }>(this.data, "labels", { frames, cleared, cars: labels });
    this.showStatus(`saved: ${countText(cars, "car")} in ${this.data.labels}`);
  }

  // -- controls --------------------------------------------------------------------------------------------------------

  private listen(): void {
    const container = this.map.getContainer();
    container.addEventListener("pointerdown", (event) => this.pressed(event));
    container.addEventListener("pointermove", (event) => this.hover(event));
    window.addEventListener("pointerup", (event) => this.released(event));
    window.addEventListener("pointercancel", () => (this.from = null));
    find("previous").addEventListener("click", () => this.show(this.frame - 1));
    find("next").addEventListener("click", () => this.show(this.frame + 1));
    find("remove").addEventListener("click", () => this.remove());
    find("none").addEventListener("click", () => this.toggleEmpty());
    find("confirm").addEventListener("click", () => this.changed());
    const move = find<HTMLInputElement>("move");
    move.addEventListener("change", () => this.setDragging(move.checked));
    const width = find<HTMLInputElement>("width");
    width.addEventListener("change", () => this.widen(Number(width.value)));
    document.addEventListener("keydown", (event) => this.key(event));
    document.addEventListener("keyup", (event) => {
      if (event.key === " ") this.setDragging(move.checked);
    });
  }

  private setDragging(on: boolean): void {
    if (on) this.map.dragging.enable();
    else this.map.dragging.disable();
  }

  private toggleEmpty(): void {
    if (!this.empty.delete(this.name)) this.empty.add(this.name);
    this.changed();
  }

  private hover(event: PointerEvent): void {
    if (!this.from) return;
    this.draw();
    const car = carFromEnds(this.name, toPoint(this.from), toPoint(this.map.mouseEventToLatLng(event)), this.ratio);
    const shape = corners(car).map((corner) => toLatLng(corner.x, corner.y));
    this.drawn.addLayer(L.polygon(shape, { color: "#ffd400", weight: 2, dashArray: "4 4", interactive: false }));
  }

  private key(event: KeyboardEvent): void {
    if (event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey || event.altKey) return;
    const action = this.actions(event.shiftKey ? 5 : 0.5)[event.key];
    if (!action || (event.key === " " && event.target instanceof HTMLButtonElement)) return;
    action();
    event.preventDefault();
  }

  private actions(step: number): Record<string, () => void> {
    const width = this.selected?.width_px ?? 0;
    return {
      Delete: () => this.remove(),
      Backspace: () => this.remove(),
      "[": () => this.widen(width - 0.5),
      "]": () => this.widen(width + 0.5),
      ArrowLeft: () => this.shift(-step, 0),
      ArrowRight: () => this.shift(step, 0),
      ArrowUp: () => this.shift(0, -step),
      ArrowDown: () => this.shift(0, step),
      "+": () => this.map.zoomIn(0.5),
      "-": () => this.map.zoomOut(0.5),
      " ": () => this.setDragging(true),
    };
  }
}

new Annotator(served<ServerData>());
