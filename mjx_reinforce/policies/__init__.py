"""Policies: action distributions, networks, and the statistics that scale observations."""
