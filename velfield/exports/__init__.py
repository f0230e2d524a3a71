"""What goes out: formats that others read."""
