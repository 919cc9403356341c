"""A run as it goes on, without screen or files: programs, state, measurements, checkpoints.

``programs`` move a ``state`` on by a ``block`` of updates, ``driver`` calls them, ``record`` holds
what they measure, and ``checkpoint`` and ``resume`` take a run back to where it was.
"""
