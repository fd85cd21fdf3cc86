"""Compositors, all behind the same two functions, made from the element-wise functions of `pixel`.

What the renderer imports:

- `choice` says which compositor runs where: `native`, `pallas` or `xla`.
- `xla` composites with array operations, on every device; the others are compared with it.
- `native` composites and lists tiles in loops compiled for this CPU. `pallas` composites in kernels for GPUs.
- `packing` lays splats and texture regions out as plain arrays, for both.
- `manual_axes` says along which axes of a mesh their results vary, inside `shard_map`.
- `ssim` is a score of two images over windows, as a native loop: the loss uses it for SSIM.

How native loops are made (docs/compiler.md):

- From JAX to LLVM: `traced` has the scalar functions that are compiled, `lanes` walks their jaxprs; `primitives` has
  JAX's arithmetic, `structure` its calls, branches, loops and small arrays, `elementary` exp, log, sine and the like,
  `libm` those of the C library, and `vectors` the operations on vectors of lanes that all of them emit.
- Loops around that: `writer` writes a function with loops and memory; `loops` those over tiles, splats and pixels,
  with `texels` for texture lookups, and `lists` those that list the splats of each tile.
- Running them: `jit` compiles a module, `ffi` lets XLA call Python functions on its buffers, through the `gate` that
  closes when the program ends; `threads` shares the work, `sums` adds up what threads have summed, and `dump` writes
  down what was compiled, where A2TG_DUMP asks for it.
"""
