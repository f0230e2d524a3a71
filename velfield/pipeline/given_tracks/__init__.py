"""`velfield run --tracks`: tracks of another program in place of frames."""
