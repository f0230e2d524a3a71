"""What a traffic engineer asks of a field: carriageways and their speeds, where traffic stops, slows or turns back.

Pure functions on the field's (y, x) layers or on the segment table; they return tables of places, in base pixels.
"""
