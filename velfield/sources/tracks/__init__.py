"""Tracks of other programs: a table of formats, readers of their files, times and units, and checks of the values."""
