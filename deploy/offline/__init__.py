"""Runs from recordings: learning without a robot, and replay."""
