"""Scalar JAX functions compiled by LLVM into loops over tiles, splats and pixels (docs/compiler.md)."""
