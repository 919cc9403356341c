"""The engine on a GPU where lanes of a warp play an episode together; see ``device``."""
