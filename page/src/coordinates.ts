// Base pixels and the map's coordinates. Pixel (0, 0) is the centre of the top-left pixel, whose corner is the map's.

import L from "leaflet";

export interface Point {
  x: number;
  y: number;
}

export const toLatLng = (x: number, y: number): L.LatLng => L.latLng(-(y + 0.5), x + 0.5);
export const toPoint = (at: L.LatLng): Point => ({ x: at.lng - 0.5, y: -at.lat - 0.5 });
