"""The version of the code, and of each stage: raise a stage's number when its results change."""

from importlib.metadata import version

STAGE_VERSIONS: dict[str, int] = {
    "frames": 1,
    "lens": 6,
    "base": 4,
    "registration": 4,
    "detector": 16,
    "detections": 8,
    "tracklets": 1,
    "tracks": 3,
    "field": 3,
    "maps": 4,
}


def code_version() -> str:
    """The installed version of velfield."""
    return version("velfield")
