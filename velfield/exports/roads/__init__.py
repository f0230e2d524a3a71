"""Lanes and the vehicles on them for other programs: SUMO, OpenDRIVE, tables of trajectories."""
