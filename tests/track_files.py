"""Files of tracks in many formats, of the same eight vehicles: from the west at 10 m/s, then left, to the north."""

import gzip
import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from rasterio.crs import CRS
from rasterio.warp import transform

SPEED_M_PER_S, FOOT_M = 10.0, 0.3048
VEHICLES, STEP_S, LEG_M = 8, 0.2, 70.0


def vehicles() -> pd.DataFrame:
    """``id, frame, t, east, north, length`` of the vehicles, m and s; a vehicle sets off every 4 s."""
    parts = []
    s = np.arange(0.0, 2 * LEG_M, SPEED_M_PER_S * STEP_S)
    for k in range(VEHICLES):
        east, north = np.minimum(s, LEG_M), np.maximum(s - LEG_M, 0.0)
        frame = 20 * k + np.arange(len(s))
        parts.append(pd.DataFrame({"id": k + 1, "frame": frame, "t": frame * STEP_S, "east": east, "north": north}))
    return pd.concat(parts, ignore_index=True).assign(length=4.5, width=1.8)


def heading_rad(table: pd.DataFrame) -> pd.Series:
    return pd.Series(np.where(table["east"] < LEG_M, 0.0, np.pi / 2))


def degrees(table: pd.DataFrame, origin: tuple[float, float] = (13.4, 52.5)) -> tuple[np.ndarray, np.ndarray]:
    """Longitudes and latitudes of the positions about a place."""
    utm, wgs84 = CRS.from_epsg(32633), CRS.from_epsg(4326)
    (e,), (n,) = transform(wgs84, utm, [origin[0]], [origin[1]])
    lon, lat = transform(utm, wgs84, table["east"] + e, table["north"] + n)
    return np.asarray(lon), np.asarray(lat)


def geotrax(t: pd.DataFrame) -> pd.DataFrame:
    lon, lat = degrees(t)
    stamps = pd.Timestamp("2022-10-07T17:52:13.500") + pd.to_timedelta(t["t"], unit="s")
    return pd.DataFrame(
        {"Vehicle_ID": t["id"], "Timestamp": stamps.dt.strftime("%Y-%m-%d %H:%M:%S.%f"), "Frame_Number": t["frame"]}
        | {"Ortho_X": 3000 + t["east"] * 33.3, "Ortho_Y": 9000 - t["north"] * 33.3}
        | {"Local_X": 170201 + t["east"], "Local_Y": 532274 + t["north"], "Latitude": lat, "Longitude": lon}
        | {"Vehicle_Length": t["length"], "Vehicle_Width": t["width"], "Vehicle_Speed": 36.0}
    )


def ngsim(t: pd.DataFrame) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "Vehicle_ID": t["id"],
            "Frame_ID": t["frame"],
            "Global_Time": (1118846980200 + t["t"] * 1000).round().astype(int),
        }
        | {"Local_X": t["east"] / FOOT_M, "Local_Y": t["north"] / FOOT_M, "v_Length": 14.8, "v_Width": 5.9}
        | {"v_Vel": SPEED_M_PER_S / FOOT_M, "Lane_ID": 1}
    )


def ind(t: pd.DataFrame) -> pd.DataFrame:
    v = heading_rad(t)
    return pd.DataFrame(
        {"recordingId": 0, "trackId": t["id"], "frame": t["frame"], "xCenter": t["east"], "yCenter": t["north"] - 90}
        | {"heading": np.degrees(v), "width": t["width"], "length": t["length"]}
        | {"xVelocity": SPEED_M_PER_S * np.cos(v), "yVelocity": SPEED_M_PER_S * np.sin(v)}
    )


def highd(t: pd.DataFrame) -> pd.DataFrame:
    v = heading_rad(t)
    return pd.DataFrame(
        {
            "frame": t["frame"],
            "id": t["id"],
            "x": t["east"] - 2.25,
            "y": 99 - t["north"] - 0.9,
            "width": 4.5,
            "height": 1.8,
        }
        | {"xVelocity": SPEED_M_PER_S * np.cos(v), "yVelocity": -SPEED_M_PER_S * np.sin(v), "laneId": 1}
    )


def interaction(t: pd.DataFrame) -> pd.DataFrame:
    v = heading_rad(t)
    return pd.DataFrame(
        {"track_id": t["id"], "frame_id": t["frame"] + 1, "timestamp_ms": (t["t"] * 1000).round().astype(int) + 100}
        | {"agent_type": "car", "x": 1000 + t["east"], "y": 980 + t["north"]}
        | {"vx": SPEED_M_PER_S * np.cos(v), "vy": SPEED_M_PER_S * np.sin(v), "psi_rad": v, "length": 4.5, "width": 1.8}
    )


def sind(t: pd.DataFrame) -> pd.DataFrame:
    return interaction(t).assign(ax=0.0, ay=0.0, v_lon=SPEED_M_PER_S, v_lat=0.0).drop(columns="psi_rad")


def citysim(t: pd.DataFrame) -> pd.DataFrame:
    east, south = t["east"], 100 - t["north"]
    return pd.DataFrame(
        {"frameNum": t["frame"], "carId": t["id"], "carCenterX": east * 18, "carCenterY": south * 18}
        | {"carCenterXft": east / FOOT_M, "carCenterYft": south / FOOT_M, "speed": SPEED_M_PER_S / 0.44704}
    )


def opendd(t: pd.DataFrame) -> pd.DataFrame:
    return pd.DataFrame(
        {"TIMESTAMP": t["t"], "OBJID": t["id"], "UTM_X": 619000 + t["east"], "UTM_Y": 5807000 + t["north"]}
        | {"V": SPEED_M_PER_S, "CLASS": "Car", "WIDTH": 1.8, "LENGTH": 4.5}
    )


def argoverse(t: pd.DataFrame) -> pd.DataFrame:
    return pd.DataFrame(
        {"TIMESTAMP": 315968000.0 + t["t"], "TRACK_ID": t["id"], "OBJECT_TYPE": "OTHERS"}
        | {"X": t["east"], "Y": t["north"], "CITY_NAME": "PIT"}
    )


def argoverse_2(t: pd.DataFrame) -> pd.DataFrame:
    v = heading_rad(t)
    return pd.DataFrame(
        {"track_id": t["id"], "timestep": t["frame"], "position_x": t["east"], "position_y": t["north"]}
        | {"velocity_x": SPEED_M_PER_S * np.cos(v), "velocity_y": SPEED_M_PER_S * np.sin(v), "scenario_id": "a"}
    )


def wide(t: pd.DataFrame, header: str, columns: list[pd.Series], fixed: str) -> str:
    """A row a vehicle: its name, ``fixed``, and the columns of each time in turn."""
    values = np.column_stack(columns)
    rows = [
        f"{number}; {fixed}" + "; ".join(f"{value:.8f}" for value in values[rows].ravel()) + "; "
        for number, rows in t.groupby("id").indices.items()
    ]
    return "\n".join([header, *rows, ""])


def datafromsky(t: pd.DataFrame) -> str:
    zero = t["t"] * 0
    header = "Track ID; Type; Entry Gate; Entry Time [s]; Exit Gate; Exit Time [s]; Traveled Dist. [m]; "
    header += "Avg. Speed [km/h]; Trajectory(x [m]; y [m]; Speed [km/h]; Tan. Acc. [ms-2]; Lat. Acc. [ms-2]; Time [s]; "
    columns = [t["east"], t["north"], zero + 36, zero, zero, t["t"], heading_rad(t)]
    return wide(t, header + "Angle [rad]; )", columns, "Car; -; -; -; -; 140.0; 36.0; ")


def pneuma(t: pd.DataFrame) -> str:
    lon, lat = degrees(t)
    zero = t["t"] * 0
    columns = [pd.Series(lat), pd.Series(lon), zero + 36, zero, zero, t["t"]]
    header = "track_id; type; traveled_d; avg_speed; lat; lon; speed; lon_acc; lat_acc; time"
    return wide(t, header, columns, "Car; 140.0; 36.0; ")


def fcd(t: pd.DataFrame, *, geo: bool = False) -> str:
    x, y = degrees(t) if geo else (t["east"].to_numpy(), t["north"].to_numpy())
    angle = np.degrees(np.pi / 2 - heading_rad(t))
    steps = [
        f'<timestep time="{time:.2f}">'
        + "".join(
            f'<vehicle id="v{t["id"][k]}" x="{x[k]:.7f}" y="{y[k]:.7f}" angle="{angle[k]:.2f}" speed="10.00"/>'
            for k in rows
        )
        + "</timestep>"
        for time, rows in t.groupby("t").indices.items()
    ]
    return "<fcd-export>\n" + "\n".join(steps) + "\n</fcd-export>\n"


def mot(t: pd.DataFrame) -> str:
    boxes = pd.DataFrame({"f": t["frame"] + 1, "i": t["id"], "l": t["east"] * 5 - 10, "t": (99 - t["north"]) * 5 - 10})
    return boxes.assign(w=20, h=20, c=1, x=-1, y=-1, z=-1).to_csv(index=False, header=False)


def csv_text(table: pd.DataFrame) -> str:
    return str(table.to_csv(index=False))


FORMATS: dict[str, tuple[Callable[[pd.DataFrame], pd.DataFrame | str], str, dict[str, object]]] = {
    "geo-trax": (geotrax, "tracks.csv", {}),
    "NGSIM": (ngsim, "trajectories.csv", {}),
    "inD": (ind, "tracks.csv", {"fps": 5.0}),
    "highD": (highd, "tracks.csv", {"fps": 5.0}),
    "INTERACTION": (interaction, "vehicle_tracks_000.csv", {}),
    "SinD": (sind, "Veh_smoothed_tracks.csv", {}),
    "CitySim": (citysim, "IntersectionA-01.csv", {"fps": 5.0}),
    "openDD": (opendd, "rdb1.csv", {}),
    "Argoverse": (argoverse, "1.csv", {}),
    "Argoverse 2": (argoverse_2, "scenario.csv", {"fps": 5.0}),
    "DataFromSky": (datafromsky, "tracks.csv", {}),
    "pNEUMA": (pneuma, "20181024_d1_0830_0900.csv", {}),
    "SUMO FCD": (fcd, "fcd.xml", {}),
    "SUMO FCD in degrees": (lambda t: fcd(t, geo=True), "fcd.xml", {}),
    "MOT Challenge": (mot, "gt.txt", {"fps": 5.0, "gsd_m": 0.2}),
}
"""Format -> what makes its file of `vehicles`, the file's usual name, and the options it needs."""


def write_format(name: str, folder: Path) -> tuple[Path, dict[str, object]]:
    """The file of a format in a folder, and the options it needs."""
    make, file_name, options = FORMATS[name]
    content = make(vehicles())
    path = folder / file_name
    path.write_text(content if isinstance(content, str) else csv_text(content))
    return path, options


@dataclass(frozen=True)
class Variant:
    """A file made by rule; ``right``: it is read as it was meant, else it must be refused in one line."""

    name: str
    file_name: str
    data: bytes
    options: dict[str, object]
    right: bool = True


_AXES: dict[str, tuple[str, str, Callable[[pd.DataFrame], tuple[pd.Series, pd.Series]], dict[str, object]]] = {
    "m down": ("x_m", "y_m", lambda t: (t["east"], 90 - t["north"]), {}),
    "utm": ("utm_x", "utm_y", lambda t: (391000 + t["east"], 5817000 + t["north"]), {}),
    "east": ("Easting", "Northing", lambda t: (t["east"], t["north"]), {}),
    "px": ("x_px", "y_px", lambda t: (t["east"] * 5, (90 - t["north"]) * 5), {"gsd_m": 0.2}),
    "said m up": ("x", "y", lambda t: (t["east"], t["north"]), {"unit": "m", "y_axis": "up"}),
    "said ft down": (
        "X",
        "Y",
        lambda t: (t["east"] / FOOT_M, (90 - t["north"]) / FOOT_M),
        {"unit": "ft", "y_axis": "down"},
    ),
    "bracket ft up": ("x [ft]", "y [ft]", lambda t: (t["east"] / FOOT_M, t["north"] / FOOT_M), {"y_axis": "up"}),
    "bracket px": ("x [px]", "y [px]", lambda t: (t["east"] * 5, (90 - t["north"]) * 5), {"gsd_m": 0.2}),
    "degrees": ("Longitude", "Latitude", lambda t: tuple(map(pd.Series, degrees(t))), {}),
    "said degrees": ("x", "y", lambda t: tuple(map(pd.Series, degrees(t))), {"unit": "deg"}),
}
_EPOCH = pd.Timestamp("2025-10-26T00:59:30Z")


def _iso(t: pd.Series, zone: str) -> pd.Series:
    moments = _EPOCH + pd.to_timedelta(t, unit="s")
    if zone == "Z":
        return moments.dt.strftime("%Y-%m-%dT%H:%M:%S.%f") + "Z"
    local = moments.dt.tz_convert("Europe/Berlin")  # +02:00, then +01:00
    return local.map(lambda moment: moment.isoformat(sep=" "))


_TIMES: dict[str, tuple[str, Callable[[pd.DataFrame], pd.Series], dict[str, object]]] = {
    "s": ("time_s", lambda t: t["t"], {}),
    "ms": ("timestamp_ms", lambda t: (t["t"] * 1000).round().astype("int64"), {}),
    "epoch s": ("timestamp", lambda t: 1761440370 + t["t"], {}),
    "epoch ms": ("timestamp", lambda t: (1761440370000 + t["t"] * 1000).round().astype("int64"), {}),
    "epoch us": ("Time", lambda t: 1761440370000000 + (t["t"] * 10).round().astype("int64") * 100000, {}),
    "epoch ns": ("time", lambda t: 1761440370000000000 + (t["t"] * 10).round().astype("int64") * 100000000, {}),
    "iso Z": ("time", lambda t: _iso(t["t"], "Z"), {}),
    "iso zones": ("datetime", lambda t: _iso(t["t"], "Berlin"), {}),
    "midnight": (
        "time",
        lambda t: (pd.Timestamp("2025-01-01T23:59:50") + pd.to_timedelta(t["t"], unit="s")).dt.strftime("%H:%M:%S.%f"),
        {},
    ),
    "frames": ("Frame ID", lambda t: t["frame"], {"fps": 5.0}),
    "day first": (
        "time",
        lambda t: (_EPOCH + pd.to_timedelta(t["t"], unit="s")).dt.strftime("%d.%m.%Y %H:%M:%S.%f"),
        {},
    ),
}
_NAMES = ("track_id", "Vehicle ID", "ID", "trackId", "OBJECT_ID", "agent_id")
_ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "latin-1", "utf-16-le")
_SEPARATORS = (",", ";", "\t", "|", ";,", " ")
"""``;,``: semicolons and decimal commas."""


def variants() -> Iterator[Variant]:
    """Axes and units x times, encodings, separators and names of columns in turn: each pair of axes and times once."""
    t = vehicles()
    number = 0
    for axes, (x_name, y_name, xy, said) in _AXES.items():
        for times, (time_name, stamp, also) in _TIMES.items():
            x, y = xy(t)
            name = _NAMES[number % len(_NAMES)]
            table = pd.DataFrame({name: t["id"], time_name: stamp(t), x_name: x, y_name: y, "Größe": "Pkw"})
            encoding, separator = _ENCODINGS[number % len(_ENCODINGS)], _SEPARATORS[number // 2 % len(_SEPARATORS)]
            if separator == " " and (
                table.astype(str).map(lambda v: " " in v).any(axis=None) or " " in "".join(table.columns)
            ):
                separator = "\t"
            text = table.to_csv(
                index=False, sep=separator[0], decimal="," if separator == ";," else ".", quoting=number % 2
            )
            data = text.encode(encoding)
            packed = number % 7 == 0
            yield Variant(
                f"{axes}, {times}, {name}, {encoding}, {separator!r}",
                "tracks.csv.gz" if packed else "tracks.csv",
                gzip.compress(data) if packed else data,
                {**said, **also},
            )
            number += 1


def ambiguous() -> Iterator[Variant]:
    """Files that can be read in two ways, or whose values contradict each other: one line each."""
    t = vehicles()
    plain = pd.DataFrame({"id": t["id"], "time": t["t"], "x_m": t["east"], "y_m": 90 - t["north"]})

    def of(name: str, table: pd.DataFrame | str, **options: object) -> Variant:
        text = table if isinstance(table, str) else csv_text(table)
        return Variant(name, "tracks.csv", text.encode(), options, right=False)

    renamed = plain.rename(columns={"x_m": "x", "y_m": "y"})
    yield of("no unit", renamed)
    yield of("metres, no axis", renamed, unit="m")
    yield of("feet in brackets, no axis", plain.rename(columns={"x_m": "x [ft]", "y_m": "y [ft]"}))
    yield of("local_x alone", plain.rename(columns={"x_m": "Local_X", "y_m": "Local_Y"}))
    yield of("frames, no fps", plain.rename(columns={"time": "frame"}))
    yield of("pixels, no size", plain.rename(columns={"x_m": "x_px", "y_m": "y_px"}))
    yield of(
        "latitude and longitude swapped",
        pd.DataFrame({"id": t["id"], "time": t["t"], "lat": 120 + t["east"] / 1e5, "lon": t["north"]}),
    )
    yield of(
        "times in microseconds called ms",
        plain.assign(time=(1761440370000000 + t["t"] * 1e6).astype("int64")).rename(columns={"time": "time_ms"}),
    )
    yield of("milliseconds called seconds", plain.assign(time=t["t"] * 1000, speed_mps=10.0))
    yield of("seconds called milliseconds", plain.rename(columns={"time": "time_ms"}))
    yield of("days of a spreadsheet", plain.assign(time=45956.0 + t["t"] / 86400))
    yield of("date without separators", plain.assign(time=20251026025930000 + (t["t"] * 1000).astype("int64")))
    yield of(
        "feet called metres, with a speed",
        plain.assign(x_m=t["east"] / FOOT_M, y_m=t["north"] / FOOT_M, speed_kmh=36.0),
    )
    yield of("metres called feet by NGSIM", ngsim(t).assign(Local_X=t["east"], Local_Y=t["north"]))
    yield of("wrong frames a second", ind(t), fps=25.0)
    yield of(
        "metres by degrees",
        plain.assign(x_m=t["east"] * 3.28, y_m=-t["north"] * 3.28, lon=degrees(t)[0], lat=degrees(t)[1]),
    )
    yield of("two vehicles in one name", plain.assign(id=(t["id"] + 1) // 2))
    yield of("two recordings, no column of them", pd.concat([plain, plain.assign(x_m=plain["x_m"] + 9)]))
    local = pd.Series(_iso(t["t"], "Berlin"))
    yield of("zones for some", plain.assign(time=local.where(t["id"] > 1, local.str[:-6])))
    yield of("clock set back, no zone", plain.assign(time=local.str[:-6]))
    yield of("day or month", plain.assign(time=np.where(t["t"] < 10, "01/02/2025 10:00:01", "02/02/2025 10:00:01")))
    yield of("minutes and seconds", plain.assign(time="10:30"))
    yield of("whole seconds, frames", plain.assign(time=t["t"].astype(int), frame=t["frame"]))
    yield of("decimal commas between commas", "id,time,x_m,y_m\n" + "".join(f"1,0,{k},{k},5,90,0\n" for k in range(20)))
    yield of("thousands and decimals", "id;time;x_m;y_m\n" + "".join(f"1;{k};1,234,{k:03d};5\n" for k in range(20)))
    yield of("no header", "1,0.0,5.0,6.0\n1,0.2,7.0,6.0\n1,0.4,9.0,6.0\n")
    yield of("one column", "hello\nworld\n")
    yield of("no rows", "id,time,x_m,y_m\n")
    yield of("nothing", "")
    yield of("text for a number", "id,time,x_m,y_m\n1,0,hello,2\n1,1,3,2\n")
    yield of("infinite frame", "track_id,frame,x_px,y_px\n1,1,2,3\n1,inf,2,3\n", fps=5.0, gsd_m=0.2)
    yield of("a name missing", "id,time,x_m,y_m\n1,0,1,2\n,1,3,2\n")
    yield of("a time missing", "id,time,x_m,y_m\n1,0,1,2\n1,,3,2\n")
    yield of("none moves", plain.assign(x_m=plain["x_m"] / 1000, y_m=plain["y_m"] / 1000))
    yield of("faster than cars", plain.assign(x_m=plain["x_m"] * 20, y_m=plain["y_m"] * 20))
    yield of("JSON", '{"tracks": []}')
    yield Variant("ZIP", "tracks.csv", b"PK\x03\x04" + bytes(40), {}, right=False)
    yield Variant("SQLite", "tracks.sqlite", b"SQLite format 3\x00" + bytes(90), {}, right=False)
    yield Variant("damaged gz", "tracks.csv.gz", gzip.compress(csv_text(plain).encode())[:90], {}, right=False)
    yield Variant("damaged Parquet", "tracks.parquet", b"PAR1 and no more", {}, right=False)
    yield Variant("bytes", "tracks.csv", b"\x00\x01\x02\xff" * 50, {}, right=False)
    yield Variant("XML of another kind", "fcd.xml", b"<net><edge/></net>", {}, right=False)


def parquet_bytes(table: pd.DataFrame) -> bytes:
    sink = io.BytesIO()
    table.to_parquet(sink)
    return sink.getvalue()
