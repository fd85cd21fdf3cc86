"""Accelerated compositors behind the same functions. On CPUs: native loops made from the functions in `pixel`.

`lanes` translates scalar JAX functions to LLVM vector code, `loops` puts them into loops over tiles, splats and
pixels, `library` compiles these, `foreign` lets XLA call them, and `native` is what the renderer uses.
"""
