"""A run on this machine: which processes, how they are started, watched and summed up."""
