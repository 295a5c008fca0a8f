"""Simulated cloth: engines that move it, a camera that sees it, points to pick it up at.

Nothing is imported here, so that the engine's own process starts without the picture's libraries.
"""
