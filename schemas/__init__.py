"""Pydantic models of velfield: the flight's configuration, and the columns and arrays of every store.

The lowest floor of the house: imports nothing of ``velfield`` or ``flows``.
"""
