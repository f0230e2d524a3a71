"""Results of `velfield analyse`, in ``RUN/analysis/``: ``analysis.json``, ``lanes.json``. Points are (x, y), px."""

from typing import Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from schemas.model import Model

ANALYSIS_VERSION = 1
"""Version of these files."""

Point = tuple[float, float]
Turn = Literal["straight", "left", "right", "u-turn"]
JunctionKind = Literal["intersection", "roundabout", "crossing", "merge", "diverge"]
"""``crossing``: roads cross and no vehicle was seen to turn; from above a bridge looks so."""
WidthSource = Literal["neighbour", "spread"]
"""``neighbour``: distance to the lane beside it; ``spread``: of the paths across it, and a car's width."""


class EstimateRecord(Model):
    """A number with its 90 % interval; all None where there is too little data for one."""

    value: float | None = None
    low: float | None = None
    high: float | None = None
    n: NonNegativeInt = 0
    """Vehicles, cycles or events that it rests on."""


class GeometryRecord(Model):
    """Where a row of a table is on the map."""

    type: Literal["Point", "LineString", "Polygon"]
    xy_px: tuple[Point, ...]


Cell = EstimateRecord | bool | int | float | str | None
"""A value of a table; None: not known."""


class AnalysisColumn(Model):
    """A column of a table."""

    name: str
    """Key of its cells."""
    title: str
    unit: str = ""
    unknown: bool = False
    """There are rows, and no number in any; the report and the page name such columns alone."""


class AnalysisRow(Model):
    """A row of a table."""

    cells: dict[str, Cell]
    geometry: GeometryRecord | None = None
    unknown: bool = False
    """There is no number in it; the report and the page count such rows alone."""


class AnalysisTable(Model):
    """A question and its answer."""

    name: str
    """Unique: ``lanes``, ``turning_counts``, ..."""
    section: str
    """Groups tables: Lanes, Movements, Speed, Signals, Flow, Conflicts, Unusual."""
    title: str
    note: str = ""
    """How it was found, what is left out, which tables of which manual were used."""
    columns: tuple[AnalysisColumn, ...]
    rows: tuple[AnalysisRow, ...]


class QuestionRecord(Model):
    """A question of the first page, and the lines of its answer."""

    question: str
    lines: tuple[str, ...]


class NameRecord(Model):
    """A name on the map: of a junction (``J0``), or of a road by which vehicles come into the picture and leave it."""

    name: str
    x_px: float
    y_px: float


class AnalysisRecord(Model):
    """``analysis.json``: all tables."""

    version: PositiveInt = ANALYSIS_VERSION
    code_version: str
    about: str = ""
    """What was analysed, when it was filmed, and its scale, for people."""
    gsd_m: PositiveFloat
    gsd_known: bool
    """False: lengths are by the paper's ground sample distance."""
    duration_s: NonNegativeFloat
    tracks: NonNegativeInt
    """Tracks of moving vehicles that were analysed."""
    seen: str = ""
    """The same for people: which vehicles these are, and in which time."""
    level: float = Field(0.9, gt=0, lt=1)
    """Probability that an interval is to have."""
    directions: str = ""
    """What N stands for in names of roads, for people."""
    names: tuple[NameRecord, ...] = ()
    answers: tuple[QuestionRecord, ...] = ()
    """The first page of the report; last, what could not be said and why."""
    tables: tuple[AnalysisTable, ...]


class LaneRecord(Model):
    """A lane: its centre line runs in the direction of travel."""

    lane: NonNegativeInt
    xy_px: tuple[Point, ...]
    length_m: NonNegativeFloat
    width_m: PositiveFloat
    width_source: WidthSource
    tracks: NonNegativeInt
    left: NonNegativeInt | None = None
    """Neighbouring lane of the same direction."""
    right: NonNegativeInt | None = None
    predecessors: tuple[NonNegativeInt, ...] = ()
    successors: tuple[NonNegativeInt, ...] = ()
    limit_m_per_s: PositiveFloat | None = None
    """Speed limit inferred from vehicles in free flow."""


class ConnectionRecord(Model):
    """From the end of a lane to the start of another."""

    start: NonNegativeInt
    end: NonNegativeInt
    tracks: NonNegativeInt
    share: float = Field(ge=0, le=1)
    """Fraction of the tracks that leave the lane ``start``."""
    turn: Turn


class JunctionRecord(Model):
    """Where lanes cross, merge or diverge."""

    junction: NonNegativeInt
    kind: JunctionKind
    x_px: float
    y_px: float
    hull_px: tuple[Point, ...]
    """Corners of the convex area in which the lanes meet."""
    lanes_in: tuple[NonNegativeInt, ...]
    lanes_out: tuple[NonNegativeInt, ...]
    lanes_inside: tuple[NonNegativeInt, ...]
    signalised: bool | None = None
    """Whether its traffic stops in a cycle; None: too little data, or lanes only merge or diverge here."""


class LanesRecord(Model):
    """``lanes.json``: the lane graph."""

    version: PositiveInt = ANALYSIS_VERSION
    gsd_m: PositiveFloat
    lanes: tuple[LaneRecord, ...]
    connections: tuple[ConnectionRecord, ...]
    junctions: tuple[JunctionRecord, ...]
