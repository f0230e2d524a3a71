// Drawings on the map over its layers: the selected pixel, the line, tracks.

import L from "leaflet";
import type { Geometry, Place } from "./analysis";
import { toLatLng, toPoint, type Point } from "./coordinates";
import { Labels } from "./labels";
import type { Near, TrackIndex } from "./tracks";

const MAX_TRACKS = 60;

export class Drawings {
  private readonly pixel = L.layerGroup();
  private readonly line = L.layerGroup();
  private readonly tracks = L.layerGroup();
  private readonly places = L.layerGroup();
  private readonly labels: Labels;
  private readonly canvas = L.canvas({ padding: 0.2 });

  constructor(private readonly map: L.Map) {
    for (const group of [this.places, this.tracks, this.pixel, this.line]) group.addTo(map);
    this.labels = new Labels(map);
  }

  showPixel(point: Point | null): void {
    this.pixel.clearLayers();
    if (!point) return;
    const box = L.latLngBounds(toLatLng(point.x - 0.5, point.y - 0.5), toLatLng(point.x + 0.5, point.y + 0.5));
    this.pixel.addLayer(L.rectangle(box, { color: "#fff", weight: 2, fill: false, interactive: false }));
    const at = toLatLng(point.x, point.y);
    this.pixel.addLayer(L.circleMarker(at, { radius: 11, color: "#000", weight: 4, fill: false, interactive: false }));
    this.pixel.addLayer(L.circleMarker(at, { radius: 11, color: "#fff", weight: 2, fill: false, interactive: false }));
  }

  /** The line with its ends, which can be dragged; `moved` gets their new positions. */
  showLine(ends: Point[] | null, moved: (ends: [Point, Point]) => void): void {
    this.line.clearLayers();
    if (!ends?.length) return;
    const points = ends.map(({ x, y }) => toLatLng(x, y));
    const strokes = [
      L.polyline(points, { color: "#000", weight: 6, opacity: 0.6, interactive: false }),
      L.polyline(points, { color: "#fff", weight: 3, interactive: false }),
    ];
    strokes.forEach((stroke) => this.line.addLayer(stroke));
    const handles = points.map((point, k) => {
      const icon = L.divIcon({ className: "handle", iconSize: [22, 22] });
      const handle = L.marker(point, { icon, draggable: ends.length === 2, keyboard: false, alt: `end ${k + 1} of the line` });
      return handle.addTo(this.line);
    });
    for (const handle of handles) {
      handle.on("drag", () => strokes.forEach((stroke) => stroke.setLatLngs(handles.map((h) => h.getLatLng()))));
      handle.on("dragend", () => moved(handles.map((h) => toPoint(h.getLatLng())) as [Point, Point]));
    }
  }

  /** The places of a table's rows with their labels, and arrows on lines; the chosen one in white; the map moves to it. */
  showPlaces(all: Place[], chosen: Geometry | null): void {
    this.places.clearLayers();
    const marked = all.filter(({ isName }) => !isName);
    for (const { geometry } of marked) this.addGeometry(geometry, "#000", 4);
    for (const { geometry } of marked) this.addGeometry(geometry, "#5ee0ff", 2);
    const first = all.filter(({ geometry }) => geometry === chosen);
    this.labels.show([...first, ...all.filter(({ geometry }) => geometry !== chosen)]);
    if (!chosen) return;
    this.addGeometry(chosen, "#000", 9);
    this.addGeometry(chosen, "#fff", 5);
    const box = L.latLngBounds(chosen.xy_px.map(([x, y]) => toLatLng(x, y)));
    if (!this.map.getBounds().contains(box)) this.map.fitBounds(box, { maxZoom: this.map.getZoom(), animate: false });
  }

  private addGeometry({ type, xy_px }: Geometry, color: string, weight: number): void {
    const points = xy_px.map(([x, y]) => toLatLng(x, y));
    const options = { renderer: this.canvas, interactive: false, color, weight };
    if (type === "Point") this.places.addLayer(L.circleMarker(points[0]!, { ...options, radius: 5 }));
    else if (type === "Polygon") this.places.addLayer(L.polygon(points, { ...options, fillOpacity: 0.08 }));
    else this.places.addLayer(L.polyline(points, options));
  }

  showTracks(near: Near[], index: TrackIndex | null): void {
    this.tracks.clearLayers();
    if (!index) return;
    for (const track of near.slice(0, MAX_TRACKS)) {
      const path = index.path(track).map(([x, y]) => toLatLng(x, y));
      const options = { renderer: this.canvas, interactive: false };
      this.tracks.addLayer(L.polyline(path, { ...options, color: "#000", weight: 4, opacity: 0.5 }));
      this.tracks.addLayer(L.polyline(path, { ...options, color: "#fff", weight: 1.5 }));
      const end = path[path.length - 1]!;
      this.tracks.addLayer(L.circleMarker(end, { ...options, radius: 3, color: "#000", weight: 1, fillColor: "#fff", fillOpacity: 1 }));
    }
  }
}
