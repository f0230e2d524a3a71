// A map of the user's own beside the run's picture: web map tiles, of a file through our server or of a tile server.

import L from "leaflet";
import { find, listenToKeys } from "./dom";

/** Longitude and latitude, degrees. */
export type Place = [number, number];

/** What the server tells of the map. */
export interface ReferenceMap {
  name: string;
  url: string;
  remote: boolean;
  bounds: [number, number, number, number] | null; // west, south, east, north
  zoom?: number; // finer tiles show nothing more
  start?: Place | null;
}

const ENLARGED = 4; // zooms beyond the finest tiles
const REMOTE_ZOOM = 19; // the finest that tile servers usually have
const START_ZOOM = 17;

export class ReferencePane {
  private readonly map: L.Map;
  private readonly markers: L.Marker[] = [];

  /** `choose` is told of the place that was clicked, `move` of the k-th point's new one. */
  constructor(
    private readonly reference: ReferenceMap,
    private readonly choose: (place: Place) => void,
    private readonly move: (number: number, place: Place) => void,
  ) {
    find("reference-stage").hidden = false;
    find("reference-note").hidden = false;
    find("reference-name").textContent = reference.name;
    const native = reference.zoom ?? REMOTE_ZOOM;
    const bounds = reference.bounds && toBounds(reference.bounds);
    this.map = L.map(find("reference"), {
      attributionControl: false,
      boxZoom: false,
      doubleClickZoom: false,
      maxZoom: native + ENLARGED,
      zoomAnimation: !window.matchMedia("(prefers-reduced-motion: reduce)").matches,
    });
    if (bounds) {
      this.map.fitBounds(bounds);
      this.map.setMinZoom(this.map.getZoom() - 1);
      this.map.setMaxBounds(bounds.pad(0.5));
    } else if (reference.start) this.map.setView(toLatLng(reference.start), START_ZOOM);
    else this.map.setView([20, 0], 2);
    this.showTiles(native, bounds);
    this.listen();
  }

  /** A numbered marker at each place that is known; the selected one is brought into view. */
  show(places: (Place | null)[], selected: number): void {
    for (const marker of this.markers.splice(0)) marker.remove();
    places.forEach((place, k) => {
      if (place === null) return;
      const marker = L.marker(toLatLng(place), {
        draggable: true,
        autoPan: true,
        icon: L.divIcon({ className: "point" }),
        keyboard: false,
      });
      marker.addTo(this.map);
      const element = marker.getElement()!;
      element.dataset.number = String(k + 1);
      element.classList.toggle("selected", k === selected);
      marker.on("dragend", () => this.move(k, toPlace(marker.getLatLng())));
      this.markers.push(marker);
    });
    const wanted = places[selected];
    if (wanted && !this.map.getBounds().contains(toLatLng(wanted))) this.map.panTo(toLatLng(wanted));
  }

  private showTiles(native: number, bounds: L.LatLngBounds | null): void {
    const options: L.TileLayerOptions = { maxNativeZoom: native, maxZoom: native + ENLARGED, noWrap: false };
    if (bounds) options.bounds = bounds;
    // The page sends no referrer elsewhere; tile servers refuse who tells none, and this one is the user's choice.
    if (this.reference.remote) options.referrerPolicy = "origin";
    const layer = L.tileLayer(this.reference.url, options);
    layer.on("tileerror", (event) => void this.complain((event.tile as HTMLImageElement).src));
    layer.addTo(this.map);
  }

  private async complain(address: string): Promise<void> {
    const problem = find("reference-problem");
    problem.hidden = false;
    if (this.reference.remote) {
      problem.textContent = `${this.reference.name} sent no image for ${address}: check the address and the network`;
      return;
    }
    const answer = await fetch(address);
    problem.textContent = answer.ok ? `${this.reference.name}: a tile was lost; load the page again` : await answer.text();
  }

  private listen(): void {
    this.map.on("click", (event) => this.choose(toPlace(event.latlng)));
    listenToKeys(this.map.getContainer(), { Enter: () => this.choose(toPlace(this.map.getCenter())) });
  }
}

const toLatLng = ([longitude, latitude]: Place): L.LatLng => L.latLng(latitude, longitude);

function toPlace(at: L.LatLng): Place {
  const { lng, lat } = at.wrap();
  return [lng, lat];
}

function toBounds([west, south, east, north]: [number, number, number, number]): L.LatLngBounds {
  return L.latLngBounds([south, west], [north, east]);
}
