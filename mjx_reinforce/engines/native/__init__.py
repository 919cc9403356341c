"""The native engine: machine code for CPUs, made with llvmlite, called by XLA without Python."""
