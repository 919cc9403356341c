"""Backends: what the scalar graph becomes."""

#: Backends: name -> "module:class" of a ``backend.Backend``.
BACKENDS = {
    "xla": "mjx_reinforce.fused.backends.xla:XLA",
    "llvm": "mjx_reinforce.fused.backends.llvm:LLVM",
    "count": "mjx_reinforce.fused.backends.count:Count",
}
