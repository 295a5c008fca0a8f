"""Rewards from demonstrations and target states (PGAIL-BiD, chapter 4): reserved for that service.

Nothing of it is in this version; presets with an `[imitation]` table are refused by `clothbus run`.
"""
