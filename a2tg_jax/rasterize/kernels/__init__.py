"""Compositors behind the same functions, made from the element-wise functions of `rasterize.pixel`.

- `platforms` chooses a compositor for the platform that JAX compiles for: `native`, `cuda` or `xla`.
- `xla` composites with array operations on every device; tests compare the others with it.
- `native` composites and lists tiles in loops compiled for this CPU; `cuda` composites in kernels for NVIDIA GPUs.
- `jaxprs` makes jaxprs of the functions of a pixel and evaluates them, for `native` and `cuda`.
- `window_scores` averages scores of two images over windows, for SSIM, by `native` or by plain array code.
"""
