"""Doing the work: the table of stages, the plan of a run, Dask graphs, configuration."""
