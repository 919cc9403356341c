"""The gradient of a small policy on an NVIDIA GPU: one kernel."""
