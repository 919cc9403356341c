"""Export: files that leave the program, trained policies and films."""
