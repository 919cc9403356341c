"""A run as it goes on, without screen or files: programs, state, measurements, checkpoints.

``state`` has the compiled programs, ``driver`` moves them on, ``record`` holds what they measure,
and ``checkpoint`` and ``resume`` take a run back to where it was.
"""
