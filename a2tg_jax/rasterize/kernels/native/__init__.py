"""Scalar JAX functions compiled by LLVM into loops over tiles, splats and pixels (docs/compiler.md).

- From JAX to LLVM: `tracing` makes jaxprs and `lanes` translates them. `primitives` translates JAX's arithmetic,
  `control_flow` its calls, branches, loops and small arrays. `elementary` has exp, log, sine and the like, `libm` the
  functions of the C library. All of them emit the operations on vectors of lanes in `vectors`.
- Loops around that: `writer` writes a function with loops and memory. `passes` writes the forward and the backward pass
  over tiles, splats and pixels, from the scalar functions in `traced` and the texture lookups in `texels`. `lists`
  writes the functions that list the splats of each tile.
- Running them: `llvm_modules` compiles a module. `ffi` lets XLA call Python functions on its buffers, through the
  `shutdown_gate`, which closes when the program ends. `threads` shares the work, `sums` adds up the gradients of all
  threads, and `dump` saves the compiled code if A2TG_DUMP is set.
- Used by the renderer and the losses: `composite` draws and lists tiles, `ssim` scores two images over windows.
"""
