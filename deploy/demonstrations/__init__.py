"""Demonstrations: who makes them, how good, and where they are kept."""
