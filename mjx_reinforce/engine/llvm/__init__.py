"""Backends: what the scalar graph becomes."""
