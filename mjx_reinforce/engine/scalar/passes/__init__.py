"""Passes: what a compiler does to the scalar graph besides writing it.

``simplify`` looks at a node as it is made: what of constants is computed at once, and what need not
be computed. ``liveness`` looks at the whole graph before a backend does: what the results need, and
in which order, and what may change in place.
"""
