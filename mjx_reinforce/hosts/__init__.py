"""Several processes that train the seeds of one run: who they are, and what they say."""
