"""Scalar JAX functions compiled by LLVM into loops over tiles, splats and pixels (docs/compiler.md).

- `lanes` translates jaxprs; `llvm_code` has arithmetic on vectors, writes functions with loops, and compiles modules.
- `passes` writes the forward and the backward pass over tiles, splats and pixels, with the textures of the splats in
  `texture_lookups`. `lists` writes the functions that list the splats of each tile.
- `ffi` lets XLA call Python functions on its buffers, on several threads. `composite` draws and lists tiles, and `ssim`
  scores two images over windows.
"""
