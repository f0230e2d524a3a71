"""The vehicles' tracks for other programs."""
