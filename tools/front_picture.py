"""The moving picture of the front page: a part of the video of a simulated run, as animated WebP.

velfield simulate FLIGHT --frames 60 --size 2560x1920 --seed 77
velfield run FLIGHT/frames --timestamps FLIGHT/timestamps.csv --gsd-m 0.23 --preset fast --out RUN
python -m tools.front_picture RUN docs/city.webp
"""

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import av
from PIL import Image

from schemas.export import ExportOptions
from velfield.exports.export import export_run
from velfield.run.run import open_run

_MAX_BYTES = 1_500_000


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--window", type=int, nargs=4, default=(670, 1030, 1100, 620), help="x, y, width, height, base px"
    )
    parser.add_argument("--width", type=int, default=880, help="of the picture, px")
    parser.add_argument("--quality", type=int, default=45)
    given = parser.parse_args()
    scale = given.width / given.window[2]
    run = open_run(given.run)
    options = ExportOptions(width_px=2 * round(run.grid.width_px * scale / 2))
    x, y, width, height = (round(value * scale) for value in given.window)
    with tempfile.TemporaryDirectory() as folder:
        clip = export_run(run, "video", Path(folder) / "clip.mp4", options)
        images, times_s = zip(
            *((image.crop((x, y, x + width, y + height)), t) for image, t in _frames(clip)), strict=True
        )
    lasts_ms = [round(1000 * (b - a)) for a, b in zip(times_s, (*times_s[1:], times_s[-1] + 0.2), strict=True)]
    images[0].save(
        given.out, save_all=True, append_images=images[1:], duration=lasts_ms, loop=0, quality=given.quality, method=6
    )
    size = given.out.stat().st_size
    if size > _MAX_BYTES:
        raise SystemExit(f"{given.out}: found {size} bytes, expected at most {_MAX_BYTES}; lower --width or --quality")
    print(f"{given.out}: {len(images)} images of {width} x {height} px, {size} bytes")


def _frames(clip: Path) -> Iterator[tuple[Image.Image, float]]:
    with av.open(str(clip)) as container:
        for frame in container.decode(video=0):
            yield frame.to_image(), float(frame.time)


if __name__ == "__main__":
    main()
