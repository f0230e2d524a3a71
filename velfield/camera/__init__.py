"""Lens models, and their calibration from the straight lines of the scene."""
