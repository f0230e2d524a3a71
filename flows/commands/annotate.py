"""``velfield annotate``: label cars by click and drag, as training data."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter


def annotate(
    place: Path,
    /,
    *,
    labels: Path | None = None,
    frames: int = 12,
    port: int | None = None,
    open_browser: Annotated[bool, Parameter(name="--open")] = True,
) -> int:
    """Label cars in the browser, by a drag along each; saved as labels for `velfield run --labels`.

    Parameters
    ----------
    place
        The image of a frame, or a run folder: frames spread over its flight.
    labels
        CSV file to write; its labels of other frames are kept. Default: `labels.csv` in the run folder, or beside the
        image.
    frames
        How many frames of a run to show.
    port
        Port to listen on. Default: any that is free.
    open_browser
        Open the browser, where there is a screen.
    """
    from flows.commands.view import serve_until_interrupted
    from velfield.viewer.annotations import frames_to_annotate
    from velfield.viewer.annotator import annotate_app

    file = labels or (place if place.is_dir() else place.parent) / "labels.csv"
    app = annotate_app(frames_to_annotate(place, max_frames=frames), file)
    serve_until_interrupted(app, port=port, open_browser=open_browser, place=place, purpose=f"writes {file}")
    return 0
