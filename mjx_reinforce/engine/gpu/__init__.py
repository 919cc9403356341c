"""Kernels for NVIDIA GPUs: an episode is a thread."""
