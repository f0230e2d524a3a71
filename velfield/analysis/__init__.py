"""Traffic engineering on a velocity field: carriageways, stops, bottlenecks, U-turns, crossings of a line.

Pure functions on the field's (y, x) layers or on the segment table; positions are base pixels. `Run.analysis` applies
them to a run folder.
"""
