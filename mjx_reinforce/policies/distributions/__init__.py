"""Action distributions, a family a file.

``distribution`` is the interface of all. ``action_range`` has the checks of the action space,
``gaussian`` what the Gaussian families share, ``normal_integrals`` their tails in numbers.
``registry.DISTRIBUTIONS`` has their names.
"""
