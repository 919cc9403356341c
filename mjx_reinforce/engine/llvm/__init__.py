"""LLVM IR of the scalar graph, which CPUs run."""
