"""Fine-tune the shipped detector on labelled frames of your own; `velfield run --detector` takes the file.

python examples/own_detector.py FRAMES LABELS GSD_M DETECTOR
"""

import sys
from pathlib import Path

from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.train import train_from_labels, write_training


def main(frames: str, labels: str, gsd_m: str, out: str, *settings: str) -> None:
    """Write the detector file; print how it does on labels left out of training."""
    config = resolve_config(settings=settings, overrides={"gsd_m": float(gsd_m)})
    training = train_from_labels(Path(frames), Path(labels), config, continued="shipped")
    print("\n".join(write_training(training, Path(out))))


if __name__ == "__main__":
    main(*sys.argv[1:])
