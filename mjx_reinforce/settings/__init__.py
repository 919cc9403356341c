"""The settings of a run: declared once, in ``groups``, and read by all others.

``declare`` has the marks of a field, ``config`` the rules and what reads what, ``defaults`` the
values, ``flags`` the command line.
"""
