"""Makes the detector that ships anew and prints how good it is on places left out: ``make detector DATA=FOLDER``."""

import sys
from pathlib import Path

import velfield.detection
from velfield.detection.ship import ship

if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: make detector DATA=FOLDER   (one that holds songdo and kit_ais)")
    shipped = Path(velfield.detection.__path__[0]) / "shipped_detector.json"
    print("\n".join(ship(Path(sys.argv[1]), shipped)))
