"""How runs of a chunk move on side by side: bytes of their states, packing, programs."""
