"""The table of track formats: columns, axes, units, times and keys of each, by which a file is recognised and read.

Names of columns are compared as `normal_name` writes them: lower case, without spaces and underscores.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Literal

Unit = Literal["m", "ft", "cm", "mm", "px", "deg"]
YAxis = Literal["up", "down"]
TimeUnit = Literal["s", "ms", "us", "ns"]
FOOT_M, MILE_PER_HOUR = 0.3048, 0.44704
UNIT_M: dict[str, float] = {"m": 1.0, "ft": FOOT_M, "cm": 0.01, "mm": 0.001}
"""Metres of the units of length."""


@dataclass(frozen=True)
class Position:
    """Columns of a position, their unit, and where y points; None: the names do not say it."""

    x: str
    y: str
    unit: Unit | None
    y_axis: YAxis | None

    @property
    def y_is_north(self) -> bool:
        """Whether the names say that y is to the north of a map's grid: UTM, east, easting."""
        return self.unit != "px" and ("utm" in self.x or "east" in self.x)


@dataclass(frozen=True)
class Speed:
    """Columns of a speed, or of a velocity's components, and m/s in their unit; None: the names do not say it."""

    columns: tuple[str, ...]
    factor: float | None


@dataclass(frozen=True)
class TrackFormat:
    """A format of tracks."""

    name: str
    """As it is printed."""
    needs: tuple[str, ...]
    """Columns by which it is recognised; the first format of `FORMATS` whose columns are all there is taken."""
    track: tuple[str, ...]
    """Columns that name a vehicle together, where they exist."""
    positions: tuple[Position, ...]
    """In order of preference; the first that has numbers is read, unless ``--unit`` asks for another."""
    times: tuple[tuple[str, TimeUnit | None], ...] = ()
    frame: str | None = None
    """Columns of the time with their units (None: by the values), and of the frame."""
    point: Literal["centre", "front", "corner"] = "centre"
    """Point of the vehicle that a position gives. A corner is the upper left one of a box; its sizes are in
    ``size``."""
    speed: Speed | None = None
    """The speed by the file, with which the positions are compared."""
    size: tuple[str, str, float] | None = None
    """Columns of length (along x of a box) and width, and metres in their unit."""
    frame_rate: float | None = None
    """Usual frames a second, for the message that asks for them."""


def _metres_up(x: str = "x", y: str = "y") -> tuple[Position, ...]:
    return (Position(x, y, "m", "up"),)


_GEOTRAX_POSITIONS = (
    Position("localx", "localy", "m", "up"),
    Position("longitude", "latitude", "deg", "up"),
    Position("orthox", "orthoy", "px", "down"),
)
_INTERACTION = TrackFormat(
    "INTERACTION",
    ("trackid", "frameid", "timestampms", "agenttype", "x", "y", "vx", "vy"),
    ("caseid", "trackid"),
    _metres_up(),
    (("timestampms", "ms"),),
    "frameid",
    speed=Speed(("vx", "vy"), 1.0),
    size=("length", "width", 1.0),
)
FORMATS = (
    TrackFormat(
        "geo-trax",
        ("vehicleid", "orthox", "orthoy"),
        ("vehicleid",),
        _GEOTRAX_POSITIONS,
        (("timestamp", None), ("localtime", None)),
        "framenumber",
        speed=Speed(("vehiclespeed",), 1 / 3.6),
        size=("vehiclelength", "vehiclewidth", 1.0),
    ),
    TrackFormat(
        "NGSIM",
        ("vehicleid", "frameid", "localx", "localy", "vvel"),
        ("location", "vehicleid"),
        (Position("localx", "localy", "ft", "up"),),
        (("globaltime", "ms"),),
        "frameid",
        point="front",
        speed=Speed(("vvel",), FOOT_M),
        size=("vlength", "vwidth", FOOT_M),
        frame_rate=10,
    ),
    TrackFormat(
        "inD, rounD, exiD or uniD",
        ("recordingid", "trackid", "frame", "xcenter", "ycenter"),
        ("recordingid", "trackid"),
        _metres_up("xcenter", "ycenter"),
        (),
        "frame",
        speed=Speed(("xvelocity", "yvelocity"), 1.0),
        size=("length", "width", 1.0),
        frame_rate=25,
    ),
    TrackFormat(
        "highD",
        ("frame", "id", "x", "y", "width", "height", "xvelocity", "yvelocity"),
        ("recordingid", "id"),
        (Position("x", "y", "m", "down"),),
        (("time", "s"),),
        "frame",
        point="corner",
        speed=Speed(("xvelocity", "yvelocity"), 1.0),
        size=("width", "height", 1.0),
        frame_rate=25,
    ),
    replace(_INTERACTION, name="SinD", needs=(*_INTERACTION.needs, "ax", "ay"), track=("trackid",)),
    _INTERACTION,
    TrackFormat(
        "DataFromSky",
        ("trackid", "datafromsky"),
        ("trackid",),
        (
            Position("x[m]", "y[m]", "m", "up"),
            Position("x[ft]", "y[ft]", "ft", "up"),
            Position("lon[deg]", "lat[deg]", "deg", "up"),
            Position("longitude[deg]", "latitude[deg]", "deg", "up"),
            Position("x[px]", "y[px]", "px", "down"),
        ),
        (("time[s]", "s"), ("time[ms]", "ms")),
        speed=Speed(("speed[km/h]",), 1 / 3.6),
    ),
    TrackFormat(
        "pNEUMA",
        ("trackid", "pneuma", "lat", "lon", "speed", "time"),
        ("trackid",),
        (Position("lon", "lat", "deg", "up"),),
        (("time", "s"),),
        speed=Speed(("speed",), 1 / 3.6),
    ),
    TrackFormat(
        "SUMO FCD",
        ("timesteptime", "vehicleid", "vehiclex", "vehicley"),
        ("vehicleid",),
        (Position("vehiclex", "vehicley", "m", "up"),),
        (("timesteptime", "s"),),
        point="front",
        speed=Speed(("vehiclespeed",), 1.0),
    ),
    TrackFormat(
        "CitySim",
        ("framenum", "carid", "carcenterx", "carcentery"),
        ("carid",),
        (
            Position("carcenterxft", "carcenteryft", "ft", "down"),
            Position("carcenterlon", "carcenterlat", "deg", "up"),
            Position("carcenterx", "carcentery", "px", "down"),
        ),
        (),
        "framenum",
        speed=Speed(("speed",), MILE_PER_HOUR),
        frame_rate=30,
    ),
    TrackFormat(
        "openDD",
        ("timestamp", "objid", "utmx", "utmy"),
        ("objid",),
        _metres_up("utmx", "utmy"),
        (("timestamp", "s"),),
        speed=Speed(("v",), 1.0),
        size=("length", "width", 1.0),
    ),
    TrackFormat(
        "Argoverse",
        ("timestamp", "trackid", "objecttype", "x", "y", "cityname"),
        ("trackid",),
        _metres_up(),
        (("timestamp", "s"),),
    ),
    TrackFormat(
        "Argoverse 2",
        ("trackid", "timestep", "positionx", "positiony", "scenarioid"),
        ("scenarioid", "trackid"),
        _metres_up("positionx", "positiony"),
        (),
        "timestep",
        speed=Speed(("velocityx", "velocityy"), 1.0),
        frame_rate=10,
    ),
    TrackFormat(
        "MOT Challenge",
        ("motframe", "motid", "bbleft", "bbtop", "bbwidth", "bbheight"),
        ("motid",),
        (Position("bbleft", "bbtop", "px", "down"),),
        (),
        "motframe",
        point="corner",
        size=("bbwidth", "bbheight", 0.0),
    ),
)
MOT_COLUMNS = ("mot frame", "mot id", "bb left", "bb top", "bb width", "bb height", "conf", "class", "visibility", "z")

RECORDINGS = ("recordingid", "recording", "caseid", "scenarioid")
"""Columns that are part of a vehicle's name in any table."""
PLACES = (
    *("location", "locationid", "droneid", "cameraid", "camera", "video", "file", "filename", "clip", "scene"),
    *("session", "cityname", "city", "sequence", "run", "date", "day", "intid", "site"),
)
"""Columns that are part of it where a vehicle would otherwise be at two places at one time."""
TRACKS = (
    *("trackid", "vehicleid", "track", "id", "vehicle", "objectid", "objid", "recordingtrackid", "carid", "vehid"),
    *("agentid", "trajectoryid", "trajid", "tid"),
)
FRAMES = ("frame", "frameid", "framenum", "framenumber", "frameno", "frameindex")
TIMES: tuple[tuple[str, TimeUnit | None], ...] = (
    *((name, "s") for name in ("times", "timestamps", "globaltimes", "time[s]", "timestamp[s]", "t[s]", "times[s]")),
    *((name, "ms") for name in ("timems", "timestampms", "globaltimems", "time[ms]", "timestamp[ms]", "t[ms]")),
    *((name, "us") for name in ("timeus", "timestampus", "time[us]", "timestamp[us]")),
    *((name, "ns") for name in ("timens", "timestampns", "time[ns]", "timestamp[ns]")),
    *((name, None) for name in ("time", "timestamp", "datetime", "timestamputc", "utctime", "timeutc", "localtime")),
    *((name, None) for name in ("globaltime", "epoch", "epochtime", "unixtime", "t", "timesteptime", "date")),
)
_PAIRS = (
    *(("x", "y"), ("xcenter", "ycenter"), ("centerx", "centery"), ("xcentre", "ycentre"), ("centrex", "centrey")),
    *(("posx", "posy"), ("positionx", "positiony"), ("xpos", "ypos"), ("cx", "cy"), ("xc", "yc")),
    *(("vehiclex", "vehicley"), ("localx", "localy"), ("globalx", "globaly"), ("xlocal", "ylocal")),
    ("carcenterx", "carcentery"),
)
POSITIONS = (
    Position("xm", "ym", "m", "down"),
    *(Position(x, y, "m", "up") for x, y in (("eastm", "northm"), ("utmx", "utmy"), ("xutm", "yutm"))),
    *(Position(x, y, "m", "up") for x, y in (("utme", "utmn"), ("easting", "northing"), ("east", "north"))),
    *(Position(x, y, "px", "down") for x, y in (("xpx", "ypx"), ("xbasepx", "ybasepx"), ("ximage", "yimage"))),
    *(Position(x, y, "px", "down") for x, y in (("pixelx", "pixely"), ("x[px]", "y[px]"), ("orthox", "orthoy"))),
    *(Position(f"{x}[m]", f"{y}[m]", "m", None) for x, y in _PAIRS),
    *(Position(f"{x}{unit}", f"{y}{unit}", "ft", None) for x, y in _PAIRS for unit in ("ft", "[ft]", "feet")),
    *(Position(x, y, None, None) for x, y in _PAIRS),
    *(
        Position(f"{x}{unit}", f"{y}{unit}", "deg", "up")
        for unit in ("", "deg", "[deg]", "[°]", "wgs84")
        for x, y in (("longitude", "latitude"), ("lon", "lat"), ("lng", "lat"), ("long", "lat"))
    ),
)
SPEEDS = (
    *(
        Speed((f"{name}{unit}",), factor)
        for name in ("speed", "velocity", "v", "vehiclespeed")
        for unit, factor in (
            *(("mpers", 1.0), ("[m/s]", 1.0), ("mps", 1.0), ("kmperh", 1 / 3.6), ("[km/h]", 1 / 3.6), ("kmh", 1 / 3.6)),
            *(("kph", 1 / 3.6), ("mph", MILE_PER_HOUR), ("[mph]", MILE_PER_HOUR), ("[ft/s]", FOOT_M), ("", None)),
        )
    ),
    Speed(("vxmpers", "vympers"), 1.0),
    Speed(("vx[m/s]", "vy[m/s]"), 1.0),
    Speed(("vx", "vy"), None),
    Speed(("xvelocity", "yvelocity"), None),
)
SIZES = (
    ("lengthm", "widthm", 1.0),
    ("vehiclelengthm", "vehiclewidthm", 1.0),
    ("vehiclelength", "vehiclewidth", 1.0),
    ("length[m]", "width[m]", 1.0),
    ("length", "width", 1.0),
)


def normal_name(name: object) -> str:
    """A column's name in lower case, without spaces, underscores and quotes; a unit in brackets stays.

    Examples
    --------
    >>> normal_name("Vehicle_ID"), normal_name(" Speed (km/h) "), normal_name("recordingId")
    ('vehicleid', 'speed[km/h]', 'recordingid')
    """
    text = str(name).strip().strip("\"'#\ufeff").lower()
    text = re.sub(r"\s*\(([^()]*)\)\s*$", r"[\1]", text)
    return re.sub(r"[^a-z0-9\[\]/°]", "", text)


def find_format(columns: Collection[str]) -> TrackFormat | None:
    """The format of a table with these columns (as of `normal_name`); None: none of the table."""
    return next((form for form in FORMATS if set(form.needs) <= set(columns)), None)
