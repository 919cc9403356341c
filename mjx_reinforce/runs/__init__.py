"""A run from its settings to its files: the plan, the directory, the screen, logs, results."""
