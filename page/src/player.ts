// The controls of the replay, and the answer of a vehicle.

import { arrow, find, make, pairs } from "./dom";
import type { Replay, Seen } from "./replay";
import type { Units } from "./units";

export function clockText(seconds: number): string {
  const minutes = Math.floor(seconds / 60);
  return `${minutes}:${(seconds - 60 * minutes).toFixed(1).padStart(4, "0")}`;
}

export class Player {
  private shown = "";

  constructor(
    private readonly replay: Replay,
    private readonly request: () => void,
    private readonly sought: () => void,
  ) {
    const slider = find<HTMLInputElement>("time");
    slider.max = String(replay.duration_s);
    slider.step = String(Math.max(0.1, +(replay.duration_s / 2000).toPrecision(1)));
    slider.addEventListener("input", () => this.seek(Number(slider.value)));
    slider.addEventListener("change", () => this.sought());
    find("play").addEventListener("click", () => this.toggle());
    const rate = find<HTMLSelectElement>("rate");
    rate.addEventListener("change", () => (replay.rate = Number(rate.value)));
    this.update();
  }

  show(on: boolean): void {
    find("player").hidden = !on;
    find("player").parentElement!.classList.toggle("replaying", on);
    if (!on) this.toggle(false);
    this.update();
  }

  toggle(playing = !this.replay.playing): void {
    this.replay.play(playing);
    if (!playing) this.sought();
    this.update();
    this.request();
  }

  private seek(time_s: number): void {
    this.replay.time_s = time_s;
    this.update();
    this.request();
  }

  /** Show the time. */
  update(): void {
    const { time_s, duration_s, playing } = this.replay;
    const text = `${clockText(time_s)} / ${clockText(duration_s)}`;
    if (text !== this.shown) {
      find("clock").textContent = this.shown = text;
      const slider = find<HTMLInputElement>("time");
      slider.value = String(time_s);
      slider.setAttribute("aria-valuetext", text);
    }
    const button = find("play");
    const label = playing ? "Pause" : "Play";
    if (button.getAttribute("aria-label") === label) return;
    button.setAttribute("aria-label", label);
    button.textContent = playing ? "❚❚" : "▶";
  }
}

const STATES: Record<string, string> = {
  moving: "in traffic",
  stopped: "stopped in a lane all the time that it was seen",
  parked: "stands throughout: a vehicle by its looks alone",
};

/** Class and length; nothing where the vehicle was not measured. */
function classText({ measured }: Seen): [string, string][] {
  if (measured === null) return [];
  const { kind, percent, length_m } = measured;
  return [
    ["Class", `${kind} (${percent < 100 ? percent : "> 99"} %)`],
    ["Length", `${length_m.toFixed(1)} m`],
  ];
}

/** The answer of a vehicle at the present time of the replay. */
export function showVehicle(seen: Seen, units: Units): HTMLElement {
  const speed = Math.hypot(seen.vx, seen.vy);
  const moves = speed > units.stationarySpeed;
  const direction = Math.atan2(seen.vy, seen.vx);
  const heading = moves ? make("span", {}, arrow(direction), ` ${units.headingText(direction)}`) : "stationary";
  const value = make("span", { "data-name": "vehicle_speed", "data-value": String(speed) }, units.speedText(speed));
  return make(
    "section",
    { class: "answer", "aria-label": "Vehicle" },
    make("h2", {}, `Vehicle ${seen.vehicle}`),
    pairs([
      ["Speed now", value],
      ["Direction", heading],
      ...classText(seen),
      ["State", STATES[seen.state] ?? seen.state],
      ["Pixel", `(${Math.round(seen.x)}, ${Math.round(seen.y)})`],
    ]),
    make("p", { class: "note" }, seen.gap ? "Not detected at this moment: the position is interpolated." : "Speed over one second."),
  );
}
