"""Episodes played fast: an engine for any environment of one step, and any policy."""
