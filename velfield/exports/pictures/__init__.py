"""Maps, report, poster and video for people."""
