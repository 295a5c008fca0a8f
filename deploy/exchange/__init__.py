"""Episodes in other formats: exported as NPZ and Minari datasets, imported from the latter."""
