"""What one unit of each stage does: read the stores, call the stage's functions, write the stores.

Between the science, which knows arrays, and ``velfield.graphs``, which knows Dask: a step knows the run folder. Each
takes
the plan and a unit's frames, and returns an ``Outcome``; ``velfield.graphs`` commits it.
"""
