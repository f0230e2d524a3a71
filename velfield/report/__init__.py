"""Figures, the report and the pages' HTML."""
