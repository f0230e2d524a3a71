"""Lanes: centre lines, their graph of connections and junctions, and profiles along them, found from tracks.

Samples of all tracks are binned by position and direction, the bins contracted onto the ridges of their density
(`ridges`), the ridges linked into lanes by the tracks that drive along them (`graph`), the centre lines fitted
(`centre_lines`), and lanes that meet or cross grouped into junctions (`junctions`).
"""
