"""``velfield annotate``: label cars by click and drag, as training data."""

from pathlib import Path

from flows.options import OpenBrowser, Port


def annotate(
    place: Path,
    /,
    *,
    labels: Path | None = None,
    frames: int = 12,
    port: Port = None,
    open_browser: OpenBrowser = True,
) -> int:
    """Label cars in the browser by dragging along each; the file is for `velfield run --labels`.

    Parameters
    ----------
    place
        Image of a frame, or a run folder: then frames spread over its flight are shown, with the vehicles that the run
        tracks as marks to correct.
    labels
        CSV file to write; its labels of other frames are kept.
        Default: `labels.csv` in the run folder, or next to the image.
    frames
        Number of frames of a run to show.
    """
    from flows.commands.view import serve_until_interrupted
    from velfield.viewer.annotations import frames_to_annotate
    from velfield.viewer.annotator import annotate_app

    file = labels or (place if place.is_dir() else place.parent) / "labels.csv"
    app = annotate_app(frames_to_annotate(place, max_frames=frames), file)
    serve_until_interrupted(app, port=port, open_browser=open_browser, place=place, purpose=f"writes {file}")
    return 0
