"""Action distributions: ``categorical``; ``gaussian``; ``bounded``, which keep to a range.

``distribution`` is the interface of all, with the checks of the action space. ``normal_integrals``
are the tails of a Normal in numbers. ``registry.DISTRIBUTIONS`` has the families by name.
"""
