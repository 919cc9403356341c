"""Rules: what each JAX primitive becomes in the scalar graph."""
