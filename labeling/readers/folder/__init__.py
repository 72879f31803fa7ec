"""Sweeps in a plain folder, in whatever files: how they are to be read is said in a small YAML beside them."""
