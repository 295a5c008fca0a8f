"""Recordings of runs as MCAP files: written, read, checked, mended and cut."""
