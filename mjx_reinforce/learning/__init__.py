"""Policies: networks to action distributions, and the statistics that scale observations."""
