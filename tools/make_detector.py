"""Trains the shipped detector again and prints its accuracy on held-out sites: ``make detector DATA=FOLDER``.

About 40 minutes on one free core; it needs PyTorch (`pip install torch`). ``python -m tools.make_detector FOLDER
--sizes-alone`` fits only the layer that measures vehicles, in some five minutes.
"""

import argparse
from pathlib import Path

from flows.launch import limit_threads, prepare_process

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path, help="folder of the sets of tools.training_data")
    parser.add_argument("--sizes-alone", action="store_true", help="keep the network, and fit its layer of sizes")
    given = parser.parse_args()
    limit_threads()
    prepare_process(verbose=False)
    import velfield.detection
    from tools.shipped_detector import fit_shipped_sizes, make_shipped_detector

    make = fit_shipped_sizes if given.sizes_alone else make_shipped_detector
    print("\n".join(make(given.data, Path(velfield.detection.__path__[0]) / "shipped_detector.json")))
