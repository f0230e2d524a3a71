"""Write the run folder of format 1 that `test_format_1` reads: ``python -m tests.run.make_format_1``.

Frozen with the release of 1.0: later versions must read this folder, so it is written again only before that release.
"""

import tempfile
import zipfile
from pathlib import Path

import numpy as np

from tests.field_runs import field_run, tracklets_along

FOLDER = Path(__file__).resolve().parents[1] / "data" / "format_1"


def main() -> None:
    """Two vehicles drive east and one south, on a map of 80 x 64 px, 35 px/s and 28 px/s."""
    paths = [np.column_stack([np.linspace(5, 75, 11), np.full(11, y)]) for y in (14.0, 15.0)]
    paths.append(np.column_stack([np.full(11, 60.0), np.linspace(4, 60, 11)]))
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "run"
        field_run(root, tracklets_along(paths), shape=(64, 80), seconds=3.0)
        with zipfile.ZipFile(FOLDER / "run.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted(path for path in root.rglob("*") if path.is_file()):
                archive.write(path, path.relative_to(root))


if __name__ == "__main__":
    main()
