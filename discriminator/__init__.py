"""Rewards from demonstrations and target states (PGAIL-BiD, chapter 4).

The cores are here: networks, losses, rewards and their trainer. The service that follows a run over
the bus is not in this version, and `clothbus run` refuses presets with an `[imitation]` table.
"""
