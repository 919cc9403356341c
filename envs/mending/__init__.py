"""Mending: what makes a model that others wrote accepted, fast, and stable."""
