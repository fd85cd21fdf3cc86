"""Scalar JAX functions compiled by LLVM into loops over tiles, splats and pixels (docs/compiler.md).

- From JAX to LLVM: `traced` has the scalar functions that are compiled, `lanes` walks their jaxprs. `primitives` has
  JAX's arithmetic, `control_flow` its calls, branches, loops and small arrays, `elementary` exp, log, sine and the
  like, `libm` those of the C library, and `vectors` the operations on vectors of lanes that all of them emit.
- Loops around that: `writer` writes a function with loops and memory. `loops` has those over tiles, splats and pixels,
  with `texels` for texture lookups, and `lists` those that list the splats of each tile.
- Running them: `llvm_modules` compiles a module. `ffi` lets XLA call Python functions on its buffers, through the
  `gate` that closes when the program ends. `threads` shares the work, `sums` adds up what threads have summed, and
  `dump` writes down what was compiled, if A2TG_DUMP asks for it.
- Used by the renderer and the losses: `composite` draws and lists tiles, `ssim` scores two images over windows.
"""
