"""Machine code for CPUs: an episode is a lane of a vector."""
