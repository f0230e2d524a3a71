"""Signals: queues at stop lines, and the cycle, green and red that they show."""
