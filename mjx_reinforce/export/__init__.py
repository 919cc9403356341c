"""Export: files that leave the program, trained policies and films, and reading them again."""
