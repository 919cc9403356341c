"""Engines: ways to play the same episodes, from the same noise, at different speeds."""
