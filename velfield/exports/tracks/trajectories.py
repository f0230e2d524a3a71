"""Trajectories as Parquet, or as CSV where the file is named so.

The columns are those of `velfield.exports.tracks.table.trajectory_table`.
"""

import io
from pathlib import Path

from schemas.export import ExportOptions
from velfield.exports.tracks.table import trajectory_table
from velfield.run.run import Run

FILE_NAME = "trajectories.parquet"


def encode(run: Run, path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`."""
    table = trajectory_table(run)
    if path.suffix.lower() == ".csv":
        return str(table.to_csv(index=False, lineterminator="\n")).encode()
    out = io.BytesIO()
    table.to_parquet(out, index=False)
    return out.getvalue()
