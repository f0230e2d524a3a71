"""The annotation page's server: serves frames and receives marks. It writes one file, the labels."""

from pathlib import Path
from typing import Any

from starlette.applications import Starlette

from schemas.annotation import Marks
from schemas.arrays import GreyImage
from velfield.report.viewer_page import render_editor
from velfield.viewer.annotations import Frames, read_marks, write_marks
from velfield.viewer.editing import editing_app


def annotate_app(frames: Frames, labels: Path) -> Starlette:
    """The server that shows ``frames`` and writes ``labels``.

    Raises
    ------
    InputError
        The labels file is of another kind, or the page is not built.
    """
    read_marks(labels)

    def page(token: str) -> str:
        return render_editor("annotate", f"Cars of {_describe(frames)}", _page_content(frames, labels, token))

    def image(number: int) -> GreyImage | None:
        return frames.read(number) if number < len(frames.names) else None

    def save(body: bytes) -> dict[str, Any]:
        after = write_marks(labels, Marks.model_validate_json(body), frames)
        return {"cars": len(after.cars), "frames": len(after.frames)}

    return editing_app(page, image, {"/labels": save})


def _describe(frames: Frames) -> str:
    return frames.names[0] if len(frames.names) == 1 else f"{len(frames.names)} frames"


def _page_content(frames: Frames, labels: Path, token: str) -> dict[str, Any]:
    before = read_marks(labels)
    shown = set(frames.names)
    return {
        "token": token,
        "labels": labels.name,
        "names": frames.names,
        "width": frames.width,
        "height": frames.height,
        "marks": {
            "frames": [name for name in before.frames if name in shown],
            "cars": [car.model_dump(mode="json") for car in before.cars if car.frame in shown],
        },
        "found": [car.model_dump(mode="json") for car in frames.found if car.frame not in before.frames],
    }
