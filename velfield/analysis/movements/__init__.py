"""Movements: who enters a junction, or the image, where, and leaves it where; U-turns."""
