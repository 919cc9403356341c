"""Rules: what each JAX primitive becomes in the scalar graph.

``scalarized`` has the tables of all files. ``structural``, ``reductions`` and ``indexing`` are the
rules for arrays; ``loops`` (with ``iterate``, which finds what a loop carries) are those for what
stays a loop or a branch.
"""
