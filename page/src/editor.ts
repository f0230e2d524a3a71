// Common to the pages that write: their image, in its own pixels, and requests to their server.

import L from "leaflet";
import { toLatLng, toPoint, type Point } from "./coordinates";
import { find } from "./dom";

/** What every such server puts into its page. */
export interface Served {
  token: string;
  width: number;
  height: number;
}

/** What the server put into the page. */
export function served<T extends Served>(): T {
  return JSON.parse(find("server-data").textContent!) as T;
}

const whole = ({ width, height }: Served): L.LatLngBounds => L.latLngBounds([0, 0], [-height, width]);

/** A map of the image's pixels, without the image; the pixel under the mouse is read out. */
export function imageMap(data: Served, options: L.MapOptions = {}): L.Map {
  const map = L.map(find("map"), {
    crs: L.CRS.Simple,
    attributionControl: false,
    boxZoom: false,
    doubleClickZoom: false,
    maxBounds: whole(data).pad(0.5),
    maxZoom: 6,
    minZoom: -6,
    zoomSnap: 0.25,
    zoomAnimation: !window.matchMedia("(prefers-reduced-motion: reduce)").matches,
    ...options,
  });
  map.fitBounds(whole(data));
  map.getContainer().addEventListener("pointermove", (event) => {
    const { x, y } = toPoint(map.mouseEventToLatLng(event));
    find("readout").textContent = `(${x.toFixed(0)}, ${y.toFixed(0)})`;
  });
  return map;
}

/** The k-th of the server's images, on the map. */
export function showImage(map: L.Map, data: Served, number: number): L.ImageOverlay {
  return L.imageOverlay(`frame/${number}.png`, whole(data), { className: "frame" }).addTo(map);
}

export function inside({ width, height }: Served, { x, y }: Point): boolean {
  return x >= -0.5 && y >= -0.5 && x <= width - 0.5 && y <= height - 0.5;
}

/** The nearest point of the image. */
export function clamp({ width, height }: Served, { x, y }: Point): Point {
  return { x: Math.min(Math.max(x, -0.5), width - 0.5), y: Math.min(Math.max(y, -0.5), height - 0.5) };
}

export const placed = ({ x, y }: Point): L.LatLng => toLatLng(x, y);

/** The server's answer; an error has the server's one line as its message. */
export async function post<T>(data: Served, path: string, content: unknown): Promise<T> {
  const headers = { "content-type": "application/json", "x-token": data.token };
  const answer = await fetch(path, { method: "POST", headers, body: JSON.stringify(content) });
  if (!answer.ok) throw new Error((await answer.text()) || `the server answered ${answer.status}`);
  return (await answer.json()) as T;
}
