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
    from velfield.viewer.annotations import frames_to_annotate
    from velfield.viewer.annotator import annotate_app
    from velfield.viewer.server import serve

    file = labels or (place if place.is_dir() else place.parent) / "labels.csv"

    def announce(address: str) -> None:
        print(f"{place}: {address}  writes {file}  (Ctrl-C ends)", flush=True)

    try:
        serve(
            annotate_app(frames_to_annotate(place, max_frames=frames), file),
            port=port,
            open_browser=open_browser,
            announce=announce,
        )
    except KeyboardInterrupt:
        print()
    return 0
