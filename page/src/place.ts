// Pixels as places of the map. Pixel (0, 0) is the centre of the top-left pixel, whose corner is the map's.

import L from "leaflet";

export interface Point {
  x: number;
  y: number;
}

export const toLatLng = (x: number, y: number): L.LatLng => L.latLng(-(y + 0.5), x + 0.5);
export const toPoint = (place: L.LatLng): Point => ({ x: place.lng - 0.5, y: -place.lat - 0.5 });
