"""Physics: MuJoCo's step in JAX, with the constraint solvers of C MuJoCo."""
