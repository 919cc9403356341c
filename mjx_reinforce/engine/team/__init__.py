"""C++ of the scalar graph, and MuJoCo's step for lanes of a warp that play together: ``device``."""
