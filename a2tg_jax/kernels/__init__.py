"""Accelerated compositors behind the same function, made from the element-wise functions in `pixel`.

`choice` says which one runs where. On CPUs, native loops (docs/compiler.md): `traced` has what is applied, `lanes`
translates it to LLVM vector code, `loops` and `lists` put that into loops (with `writer` and `texels`), `jit` compiles,
`ffi` lets XLA call the result, on `threads`, and `native` is what the renderer uses. On GPUs, `pallas`. `packing` is
common to both. `ssim` is for SSIM, made in the same way.
"""
