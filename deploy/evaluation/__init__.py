"""Scores of policies: of finished runs, and of live ones beside them."""
