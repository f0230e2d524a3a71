"""Lanes: centre lines, their graph of connections and junctions, and profiles along them, found from tracks.

Samples of all tracks are binned by position and direction, the bins contracted onto the ridges of their density
(`ridges`), short turns found from the ways between which tracks go (`turns`), the ridges and turns linked into lanes by
the tracks that drive along them (`graph`), their centre lines made (`find`), and lanes that meet or cross grouped into
junctions (`junctions`).
"""
