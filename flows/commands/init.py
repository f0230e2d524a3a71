"""``velfield init``: a commented flight.yaml to start from."""

import shlex
from pathlib import Path


def init(
    source: Path,
    /,
    *,
    out: Path = Path("flight.yaml"),
    timestamps: Path | None = None,
    fps: float | None = None,
) -> int:
    """Inspect a video, and write a commented flight.yaml with every parameter and its default.

    Parameters
    ----------
    source
        Video file, or folder of images.
    out
        The file to write; an existing one is not overwritten.
    timestamps
        CSV `frame,time_s` for a folder of images.
    fps
        Frame rate of a folder of images without timestamps.
    """
    from flows.commands.start import own_command
    from schemas.flight import FramesConfig
    from velfield.errors import InputError
    from velfield.pipeline.config_template import config_template, describe_source, describe_telemetry
    from velfield.pipeline.configuration import resolve_config
    from velfield.run.commits import write_atomically
    from velfield.sources.source import probe

    if out.exists():
        raise InputError(f"{out} exists already; give another file with --out, or move it away")
    info = probe(source, frames=FramesConfig(fps=fps), timestamps=timestamps)
    write_atomically(out, config_template(str(source), info).encode())
    print("\n".join([*describe_source(info, resolve_config()), describe_telemetry(source, info)]))
    times = ["--timestamps", str(timestamps)] if timestamps else ["--fps", f"{fps:g}"] if fps else []
    words = shlex.join(["run", str(source), *times, "--config", str(out), "--out", "RUN"])
    print(f"{out}: try  {own_command()} {words}")
    return 0
