"""Measurements against simulated truth and against other software in the same run: what `velfield bench` shows."""
