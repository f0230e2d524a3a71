"""Exports of a run to formats that other software reads."""
