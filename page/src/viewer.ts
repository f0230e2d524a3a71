// The page of a run: the map with its queries, and the summary.

import "leaflet/dist/leaflet.css";
import "./viewer.css";
import type L from "leaflet";
import { Animation, reducedMotion } from "./animation";
import { AnalysisPanel } from "./analysis";
import { lineCrossings } from "./crossings";
import { find, listenToKeys, make } from "./dom";
import { Drawings } from "./drawings";
import { Field } from "./field";
import { Flow } from "./flow";
import { makeLegend } from "./legend";
import { showLine } from "./line";
import { makeMap, Overlay } from "./map";
import { queryPixel, showTracks, showPixel } from "./pixel";
import { toLatLng, toPoint, type Point } from "./coordinates";
import { Player, showVehicle } from "./player";
import { Replay } from "./replay";
import { loadRun, type Layer, type Run } from "./run";
import { readState, writeState, type State } from "./state";
import { listenToTabs, showTab } from "./tabs";
import { loadSegments, TrackIndex } from "./tracks";
import { countText, Units } from "./units";

const TRACK_REACH_PX = 6; // screen pixels around the cursor
const POINT_REACH_PX = 8; // screen pixels: a click this near a lane selects the lane
const VEHICLE_REACH_PX = 14; // screen pixels: a click this near a vehicle of the replay selects it
const REST_MS = 60; // a resting mouse is about to click: the pixel's tile is prefetched

class Viewer {
  private state: State = readState(location.hash);
  private readonly field: Field;
  private readonly units: Units;
  private readonly map: L.Map;
  private readonly drawings: Drawings;
  private readonly animation: Animation;
  private readonly flow: Flow;
  private readonly replay: Replay;
  private readonly player: Player;
  private readonly analysis: AnalysisPanel;
  private overlay: Overlay | undefined;
  private index: Promise<TrackIndex> | undefined;
  private drawing: Point[] | null = null; // ends of a line that is being drawn
  private asked = 0;
  private resting = 0;
  private answered = 0; // when the answer of a vehicle was shown
  private hovered: Point | null = null;

  constructor(private readonly run: Run) {
    this.field = new Field(run);
    this.units = new Units(run, this.state.unit);
    this.map = makeMap(find("map"), run);
    this.drawings = new Drawings(this.map);
    this.animation = new Animation(this.map);
    this.flow = new Flow(run);
    this.replay = new Replay(run, this.speedMax(), (ended) => this.replayed(ended), (error) => this.fail(error));
    this.player = new Player(this.replay, () => this.animation.request(), () => this.keepTime());
    this.analysis = new AnalysisPanel(this.units, (all, chosen) => this.drawings.showPlaces(all, chosen));
    this.fillControls();
    this.applyView();
    this.listen();
    this.showLayer();
    this.restore();
    if (this.state.replay !== null) this.showReplay(this.state.replay);
    if (this.state.flow) this.showFlow(true);
  }

  // -- the view ---------------------------------------------------------------------------------------------------------

  private get layer(): Layer {
    return this.run.layers.find((layer) => layer.name === this.state.layer) ?? this.run.layers[0]!;
  }

  private set(change: Partial<State>): void {
    this.state = { ...this.state, ...change };
    history.replaceState(null, "", `#${writeState(this.state)}`);
  }

  private showLayer(): void {
    const { layer } = this;
    const legend = makeLegend(layer, this.run, this.units);
    find("legend").replaceChildren(legend.element);
    find("layer").title = layer.description;
    this.overlay?.remove();
    const { minVehicles, opacity } = this.state;
    this.overlay = new Overlay(this.field, layer, legend.colourMax, minVehicles, opacity / 100, (error) => this.fail(error));
    this.overlay.addTo(this.map);
  }

  /** The pixel and the line that the address names. */
  private restore(): void {
    this.drawings.showPixel(this.state.pixel);
    this.drawings.showLine(this.state.line, (ends) => this.measure(ends));
    if (this.state.line) this.measure(this.state.line);
    else if (this.state.pixel) this.ask(this.state.pixel);
  }

  private applyView(): void {
    const { view } = this.state;
    if (view) this.map.setView(toLatLng(view.x, view.y), view.zoom, { animate: false });
  }

  private answer(...elements: HTMLElement[]): void {
    const panel = find("answer");
    panel.replaceChildren(...elements);
    // On a small screen the answer is below the controls: scroll to it.
    const side = find("side");
    if (panel.offsetTop + 120 > side.scrollTop + side.clientHeight) side.scrollTop = panel.offsetTop - side.offsetTop;
  }

  private fail(error: unknown): void {
    console.error(error);
    this.answer(make("p", { class: "alarm" }, error instanceof Error ? error.message : String(error)));
  }

  // -- queries ----------------------------------------------------------------------------------------------------------

  /** `away`: distance from the point that was clicked, base pixels. */
  private ask(point: Point, away = 0, started = performance.now()): void {
    if (!this.field.inside(point.x, point.y)) return;
    this.set({ pixel: point, line: null });
    this.drawings.showPixel(point);
    this.drawings.showLine(null, () => undefined);
    const asked = ++this.asked;
    queryPixel(this.field, point)
      .then((answer) => {
        if (asked !== this.asked) return; // another pixel was queried since
        this.answer(showPixel(answer, this.field, this.units, away));
        find("answer").dataset.milliseconds = (performance.now() - started).toFixed(1);
        if (answer.n) this.addTracks(point, asked);
      })
      .catch((error) => this.fail(error));
  }

  private addTracks(point: Point, asked: number): void {
    this.tracks()
      .then((index) => {
        if (asked !== this.asked) return;
        const near = index.near(point.x, point.y, this.run.segments.band_radius_px);
        find("answer").firstElementChild?.append(showTracks(near, index, this.units));
        if (this.state.tracks) this.drawings.showTracks(near, index);
      })
      .catch((error) => this.fail(error));
  }

  private measure(ends: [Point, Point]): void {
    this.set({ line: ends, pixel: null });
    this.drawings.showPixel(null);
    this.drawings.showLine(ends, (moved) => this.measure(moved));
    const asked = ++this.asked;
    this.tracks()
      .then(({ segments }) => {
        if (asked !== this.asked) return;
        const crossings = lineCrossings(segments, ends[0], ends[1], this.run.segments.hysteresis_px);
        this.answer(showLine(crossings, ends, this.run, this.units));
      })
      .catch((error) => this.fail(error));
  }

  private tracks(): Promise<TrackIndex> {
    this.index ??= loadSegments(this.run).then((segments) => new TrackIndex(segments, this.run));
    return this.index;
  }

  /** A click, a tap, or Enter at the map's centre: an end of the line being drawn, else a query of the pixel. */
  private clickAt(point: Point): void {
    if (this.drawing === null) {
      if (!this.selectVehicle(point)) this.askNear(point);
      return;
    }
    this.drawing.push(point);
    this.drawings.showLine(this.drawing, () => undefined);
    if (this.drawing.length === 2) {
      const ends = this.drawing as [Point, Point];
      this.draw(false);
      this.measure(ends);
    } else this.showHint("Now the other side of the road.");
  }

  // -- what moves ------------------------------------------------------------------------------------------------------

  private speedMax(): number {
    const layer = this.run.layers.find(({ name }) => name === "speed") ?? this.run.layers[0]!;
    return makeLegend(layer, this.run, this.units).colourMax;
  }

  /** Show the vehicles at a time, or no longer (null). */
  private showReplay(time_s: number | null): void {
    find("replay").setAttribute("aria-pressed", String(time_s !== null));
    this.replay.selected = null;
    if (time_s !== null) this.replay.time_s = Math.min(Math.max(time_s, 0), this.replay.duration_s);
    this.player.show(time_s !== null);
    if (time_s === null) this.animation.remove(this.replay);
    else this.animation.add(this.replay);
    this.set({ replay: time_s });
    this.noteMoving();
  }

  private replayed(ended: boolean): void {
    this.player.update();
    this.showSelected();
    if (ended) this.keepTime();
  }

  private keepTime(): void {
    if (this.state.replay === null) return;
    this.set({ replay: this.replay.time_s });
    this.showSelected();
  }

  /** The answer of the selected vehicle, at most ten times a second while it moves. */
  private showSelected(): void {
    if (this.replay.selected === null) return;
    const now = performance.now();
    if (this.replay.playing && now - this.answered < 100) return;
    this.answered = now;
    const seen = this.replay.now().find(({ vehicle }) => vehicle === this.replay.selected);
    if (seen) this.answer(showVehicle(seen, this.units));
  }

  private selectVehicle(point: Point): boolean {
    const seen = this.state.replay === null ? null : this.replay.near(point, this.reach(VEHICLE_REACH_PX));
    this.replay.selected = seen?.vehicle ?? null;
    this.animation.request();
    if (!seen) return false;
    this.asked++;
    this.set({ pixel: null, line: null });
    this.drawings.showPixel(null);
    this.drawings.showLine(null, () => undefined);
    this.answered = 0;
    this.showSelected();
    return true;
  }

  private showFlow(on: boolean): void {
    const still = on && reducedMotion();
    if (still) this.showHint("The flow animation is off: this system asks for reduced motion.");
    const flows = on && !still;
    find("flow").setAttribute("aria-pressed", String(flows));
    this.set({ flow: flows });
    this.noteMoving();
    if (!flows) this.animation.remove(this.flow);
    else this.flow.load().then(() => this.state.flow && this.animation.add(this.flow), (error) => this.fail(error));
  }

  private noteMoving(): void {
    const notes: string[] = [];
    if (this.state.replay !== null) {
      notes.push("Replay: colour is speed, as in the layer Speed; grey stands throughout, a vehicle by its looks alone; pale is not detected. Click a vehicle.");
    }
    if (this.state.flow) {
      const pace = this.flow.pace(this.animation.view().scale);
      notes.push(`Flow: each particle draws its velocity from the distribution where it is; ${pace.toFixed(1)} times real speed.`);
    }
    find("moving-note").textContent = notes.join(" ");
    find("moving-note").hidden = !notes.length;
  }

  private askNear(point: Point): void {
    const [asked, started] = [++this.asked, performance.now()];
    this.selectPixel(point)
      .then((pixel) => {
        if (asked !== this.asked) return; // another point was clicked since
        const own = pixel.x === Math.round(point.x) && pixel.y === Math.round(point.y);
        this.ask(pixel, own ? 0 : Math.hypot(pixel.x - point.x, pixel.y - point.y), started);
      })
      .catch((error) => this.fail(error));
  }

  /** The pixel that a point selects: on a small screen the whole map has six pixels under each of the screen's. */
  private selectPixel(point: Point): Promise<Point> {
    return this.field.nearest(point, this.reach(POINT_REACH_PX), this.state.minVehicles);
  }

  /** Screen pixels as base pixels. */
  private reach(screenPx: number): number {
    return screenPx / this.map.getZoomScale(this.map.getZoom(), 0);
  }

  private draw(on: boolean): void {
    this.drawing = on ? [] : null;
    find("draw-line").setAttribute("aria-pressed", String(on));
    this.map.getContainer().classList.toggle("drawing", on);
    this.showHint(on ? "Click on one side of the road, then on the other. Keyboard: Enter marks the map's centre." : "");
  }

  private showHint(text: string): void {
    find("hint").textContent = text;
  }

  // -- the mouse over the map ------------------------------------------------------------------------------------------

  private hover(point: Point): void {
    this.hovered = point;
    if (!this.field.inside(Math.round(point.x), Math.round(point.y))) {
      find("readout").textContent = "";
      return;
    }
    const read = (pixel: Point): void => (this.hovered === point ? this.read(pixel, point) : undefined);
    this.selectPixel(point).then(read, (error) => this.fail(error));
    if (this.state.tracks) void this.hoverTracks(point);
  }

  /** The pixel's answer in one line. */
  private read({ x, y }: Point, hovered: Point): void {
    const readout = find("readout");
    const value = (name: string): number | undefined => this.field.peek(name, x, y);
    const [vx, vy, n] = [value("modal_vx"), value("modal_vy"), value("count")];
    const where = `(${x}, ${y})`;
    if (vx === undefined || vy === undefined || n === undefined) {
      readout.textContent = where;
      const values = ["modal_vx", "modal_vy", "count"].map((name) => this.field.at(name, x, y));
      const again = (): void => (this.hovered === hovered ? this.read({ x, y }, hovered) : undefined);
      Promise.all(values).then(again, (error) => this.fail(error));
    } else if (!n) readout.textContent = `${where} no vehicle`;
    else {
      const speed = Math.hypot(vx, vy);
      const heading = speed > this.run.stationary_speed_px_per_s ? this.units.headingText(Math.atan2(vy, vx)) : "stationary";
      readout.textContent = `${where} ${heading} · ${this.units.speedText(speed)} · ${countText(n, "vehicle")}`;
    }
    clearTimeout(this.resting);
    if (n) this.resting = window.setTimeout(() => void queryPixel(this.field, { x, y }).catch(() => undefined), REST_MS);
  }

  private async hoverTracks({ x, y }: Point): Promise<void> {
    const index = await this.tracks();
    this.drawings.showTracks(index.near(x, y, this.reach(TRACK_REACH_PX)), index);
  }

  // -- controls --------------------------------------------------------------------------------------------------------

  private fillControls(): void {
    const layers = find<HTMLSelectElement>("layer");
    const [main, more] = [make("optgroup", { label: "Main" }), make("optgroup", { label: "More" })];
    for (const layer of this.run.layers) {
      (layer.main ? main : more).append(make("option", { value: layer.name, title: layer.description }, layer.title));
    }
    layers.append(main, ...(more.childElementCount ? [more] : []));
    layers.value = this.layer.name;
    const unit = find<HTMLSelectElement>("unit");
    unit.value = this.state.unit;
    if (this.run.gsd_m === null) {
      unit.replaceChildren(make("option", {}, "px/s"));
      unit.disabled = true;
      unit.title = "metres a pixel are not known: give --gsd-m";
    }
    find("coverage-note").textContent = this.run.low_coverage_note;
    find<HTMLInputElement>("opacity").value = String(this.state.opacity);
    find<HTMLInputElement>("min-vehicles").value = String(this.state.minVehicles);
    find<HTMLInputElement>("tracks").checked = this.state.tracks;
  }

  private listen(): void {
    const on = (id: string, event: string, act: (element: HTMLInputElement) => void): void => {
      const element = find<HTMLInputElement>(id);
      element.addEventListener(event, () => act(element));
    };
    on("layer", "change", ({ value }) => {
      this.set({ layer: value });
      this.showLayer();
    });
    on("unit", "change", ({ value }) => this.changeUnit(value as State["unit"]));
    on("opacity", "input", ({ value }) => {
      this.set({ opacity: Number(value) });
      this.overlay?.setOpacity(Number(value) / 100);
    });
    on("min-vehicles", "change", (element) => {
      const minVehicles = Math.max(1, Math.round(Number(element.value)) || 1);
      element.value = String(minVehicles);
      this.set({ minVehicles });
      this.showLayer();
    });
    on("tracks", "change", ({ checked }) => {
      this.set({ tracks: checked });
      if (!checked) this.drawings.showTracks([], null);
    });
    on("replay", "click", () => {
      const begins = this.state.replay === null;
      this.showReplay(begins ? this.replay.time_s : null);
      if (begins) this.player.toggle(true);
    });
    on("flow", "click", () => this.showFlow(!this.state.flow));
    on("draw-line", "click", () => this.draw(this.drawing === null));
    on("whole", "click", () => this.map.fitBounds([[0, 0], [-this.run.height_px, this.run.width_px]]));
    on("copy-link", "click", () => void this.copyLink());
    this.listenToMap();
    window.addEventListener("hashchange", () => location.reload());
  }

  private listenToMap(): void {
    this.map.on("click", (event) => this.clickAt(toPoint(event.latlng)));
    this.map.on("mousemove", (event) => this.hover(toPoint(event.latlng)));
    this.map.on("mouseout", () => this.hover({ x: -1, y: -1 }));
    this.map.on("moveend", () => {
      const { x, y } = toPoint(this.map.getCenter());
      this.set({ view: { x, y, zoom: this.map.getZoom() } });
      this.noteMoving();
    });
    const query = (): void => this.clickAt(toPoint(this.map.getCenter()));
    listenToKeys(this.map.getContainer(), {
      Enter: query,
      " ": query,
      l: () => this.draw(this.drawing === null),
      Escape: () => this.draw(false),
      r: () => this.showReplay(this.state.replay === null ? this.replay.time_s : null),
      p: () => this.state.replay !== null && this.player.toggle(),
      f: () => this.showFlow(!this.state.flow),
    });
  }

  private changeUnit(unit: State["unit"]): void {
    this.set({ unit });
    this.units.speedUnit = unit;
    this.showLayer();
    this.restore();
  }

  private async copyLink(): Promise<void> {
    try {
      await navigator.clipboard.writeText(location.href);
      this.showHint("Link copied.");
    } catch {
      this.showHint("No access to the clipboard: copy the page's address instead.");
    }
  }

  /** What a tab shows of the map. */
  showTab(tab: State["tab"]): void {
    this.state = { ...this.state, tab };
    this.map.invalidateSize();
    const moving = tab === "map"; // the analysis has the map to itself
    this.animation.show(moving);
    this.player.show(moving && this.state.replay !== null);
    if (tab === "analysis") this.analysis.show().catch((error) => this.failAnalysis(error));
    else this.drawings.showPlaces([], null);
  }

  private failAnalysis(error: unknown): void {
    console.error(error);
    find("analysis-content").replaceChildren(make("p", { class: "alarm" }, error instanceof Error ? error.message : String(error)));
  }
}

/** Why the map cannot be shown, in its point; the summary needs no server. */
function explain(text: string): void {
  find("map").replaceChildren(make("p", { class: "alarm", role: "alert" }, text));
  find("side").hidden = true;
}

async function start(): Promise<void> {
  const { tab } = readState(location.hash);
  let viewer: Viewer | undefined;
  listenToTabs((chosen) => {
    showTab(chosen);
    const state = { ...readState(location.hash), tab: chosen };
    history.replaceState(null, "", `#${writeState(state)}`);
    viewer?.showTab(chosen);
  });
  if (location.protocol === "file:") {
    showTab("summary");
    explain("A browser reads no data from a file opened from the disk. Show this run with: velfield view RUN");
    return;
  }
  showTab(tab === "summary" ? "map" : tab); // the map needs a size to begin with
  try {
    viewer = new Viewer(await loadRun());
  } catch (error) {
    console.error(error);
    explain(`The map cannot be shown: ${error instanceof Error ? error.message : String(error)}`);
  }
  showTab(tab);
  viewer?.showTab(tab);
}

void start();
