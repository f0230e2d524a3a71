"""Frames unlike their neighbours: blurred ones, and ones that do not belong to the flight.

Both are defined by the frames around them, so they are detected over the whole flight at once: the result is the same
however the flight is cut into units. Frames with another defect are neither tested nor anybody's neighbours.
"""

import numpy as np

from schemas.arrays import IntArray
from velfield.pipeline.plan import Plan
from velfield.pipeline.progress import advance
from velfield.pipeline.result import StageResult
from velfield.run.stores import FrameStore, open_frames
from velfield.sources.flags import UNUSABLE, FrameFlag
from velfield.sources.quality import flag_blurred, flag_outlier_frames

_CHUNK = 4096
"""Thumbnails in memory at a time."""


def flag_frames(plan: Plan) -> StageResult:
    """Write the column ``flags`` of ``frames.zarr``: defects from decoding, and frames unlike their neighbours."""
    store = open_frames(plan.layout.frames, "r+")
    flags = store.column("decoding_flags")
    tested = np.flatnonzero((flags & int(UNUSABLE)) == 0)
    blurred = tested[flag_blurred(store.column("sharpness")[tested])]
    outliers = tested[_find_outliers(store, tested)]
    flags[blurred] |= int(FrameFlag.BLURRED)
    flags[outliers] |= int(FrameFlag.OUTLIER)
    times_s = store.column("time_s")
    warnings = [f"frame {k} ({times_s[k]:.3f} s) is blurred: it is left out" for k in blurred]
    warnings += [f"frame {k} ({times_s[k]:.3f} s) is unlike the frames around it: it is left out" for k in outliers]
    usable = int(np.sum((flags & int(UNUSABLE)) == 0))
    advance("quality")
    counts = {"usable": usable, "flagged": len(flags) - usable, "blurred": len(blurred), "outliers": len(outliers)}
    return StageResult([store.write_flags(flags)], {name: float(count) for name, count in counts.items()}, [], warnings)


def _find_outliers(store: FrameStore, tested: IntArray) -> IntArray:
    """Those of the tested frames, by their place among them, that are unlike the one before and the one after."""
    found = [np.empty(0, np.int64)]
    for start in range(0, len(tested), _CHUNK):
        first = max(start - 1, 0)
        frames = tested[first : start + _CHUNK + 1]
        thumbnails = store.thumbnails(int(frames[0]), int(frames[-1]) + 1)[frames - frames[0]]
        outliers = first + np.flatnonzero(flag_outlier_frames(thumbnails))
        found.append(outliers[(outliers >= start) & (outliers < start + _CHUNK)])
    return np.concatenate(found)
