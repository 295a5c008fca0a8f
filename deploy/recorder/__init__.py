"""The recorder: a copy of a run's journal and of its live traffic."""
