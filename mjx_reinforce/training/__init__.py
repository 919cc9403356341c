"""Runs as they go on, without screen or files: programs, state, measurements, checkpoints.

``programs`` move a ``state`` on by a block of updates, ``driver`` calls them, ``record`` holds
what they measure, and ``resume`` takes a run back to where it was.
"""
