"""Runs: settings, the programs that train many seeds, and what they leave on disk."""
