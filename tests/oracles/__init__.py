"""Independent references in plain NumPy, written from the textbook."""
