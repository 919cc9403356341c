"""What talks to the terminal: commands and their names, signals, streams.

Nothing here knows of settings, runs or files. ``jax_setup`` belongs here, since a command line sets
up JAX before anything else does.
"""
