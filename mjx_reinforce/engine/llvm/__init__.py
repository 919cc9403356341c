"""LLVM IR of the scalar graph: what CPUs run, and GPUs where a thread plays an episode."""
