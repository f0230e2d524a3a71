"""The run folder: its layout, its stores and tables, what is committed; reading it, and keeping it whole."""
