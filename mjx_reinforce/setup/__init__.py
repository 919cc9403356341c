"""Programs ready to run, built from settings or read from disk, and where results come from."""
