"""Trains the shipped detectors again and prints their accuracy on held-out sites: ``make detector DATA=FOLDER``.

About 40 minutes on one free core; it needs PyTorch (`pip install torch`).
"""

import sys
from pathlib import Path

from flows.launch import limit_threads, prepare_process

if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: make detector DATA=FOLDER   (one that holds the sets of tools.training_data)")
    limit_threads()
    prepare_process(verbose=False)
    import velfield.detection
    from tools.shipped_detector import make_shipped_detector

    data, folder = Path(sys.argv[1]), Path(velfield.detection.__path__[0])
    print("\n".join(make_shipped_detector(data, folder / "shipped_detector.json")))
