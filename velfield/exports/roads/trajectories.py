"""Trajectories as Parquet: the columns of `velfield.exports.roads.table.trajectory_table`."""

import io
from pathlib import Path

from schemas.export import ExportOptions
from velfield.exports.roads.table import trajectory_table
from velfield.run.run import Run

FILE_NAME = "trajectories.parquet"


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    out = io.BytesIO()
    trajectory_table(run).to_parquet(out, index=False)
    return out.getvalue()
