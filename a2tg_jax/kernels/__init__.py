"""Accelerated compositors behind the same function, made from the element-wise functions in `pixel`.

`choice` says which one runs where. On CPUs, native loops: `lanes` translates scalar JAX functions to LLVM vector code,
`loops` and `lists` put it into loops that `writer` writes and `library` compiles, `foreign` lets XLA call them, and
`native` is what the renderer uses. On GPUs, `pallas`.
"""
