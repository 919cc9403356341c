"""The settings of a run: declared once, in ``groups``, and read by all others.

``declare`` has the marks of a field, ``config`` the rules, ``relevance`` what reads what,
``defaults`` and ``presets`` values, ``flags`` and ``hints`` the command line, ``memory``,
``measured`` and ``operations`` what a machine can do with them.
"""
