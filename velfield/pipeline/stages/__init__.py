"""Functions that compute one unit of each stage: read the stores, call the stage's functions, write the stores.

Between the science, which knows arrays, and ``velfield.pipeline.graphs``, which knows Dask: a stage's module knows the
run folder. Each function takes the plan and a unit's frames, and returns an ``StageResult``, which the graph commits.
"""
