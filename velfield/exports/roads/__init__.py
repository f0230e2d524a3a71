"""Lanes for other programs: SUMO, OpenDRIVE."""
