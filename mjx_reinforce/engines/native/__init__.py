"""The native engine: machine code, made with llvmlite, that XLA calls without Python."""
