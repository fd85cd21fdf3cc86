"""Compositors behind the same functions, made from the element-wise functions of `rasterize.pixel`.

- `by_platform` calls functions whose code depends on the platform that JAX compiles for. `choice` chooses a compositor
  for a platform: `native`, `cuda` or `xla`.
- `xla` composites with array operations on every device; tests compare the others with it.
- `native` composites and lists tiles in loops compiled for this CPU; `cuda` composites in kernels for NVIDIA GPUs.
- `tracing` and `traced` make jaxprs of the functions of a pixel; `jaxprs` evaluates them, for `native` and `cuda`.
- `scores` averages scores of two images over windows, in `native` or in the plain array code of `windows`.
- `packing` packs splats and texture regions into plain arrays, for both.
"""
