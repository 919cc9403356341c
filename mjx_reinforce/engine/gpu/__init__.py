"""Kernels for NVIDIA GPUs, in which a thread or a team of lanes plays an episode."""
