"""The settings of a run: declared once, in ``groups``, and read by all others.

``declare`` has the marks of a field, ``config`` the rules and what reads what, ``defaults`` and
``tables`` values, ``flags`` the command line, ``memory`` what a machine can do with them.
"""
