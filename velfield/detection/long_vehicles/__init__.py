"""The classifier of long vehicles: lorries and buses at their centre."""
