"""What a run has measured: the rows of its tables, its broken updates, its progress; no files."""
