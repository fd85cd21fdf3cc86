"""Compositors behind the same functions, made from the element-wise functions of `rasterize.pixel`.

- `choice` chooses a compositor: `cuda`, `native` or `xla`.
- `xla` composites with array operations on every device; tests compare the others with it.
- `native` composites and lists tiles in loops compiled for this CPU; `cuda` composites in kernels for NVIDIA GPUs.
- `tracing` and `traced` make jaxprs of the functions of a pixel; `jaxprs` evaluates them, for `native` and `cuda`.
- `packing` packs splats and texture regions into plain arrays, for both.
- `manual_axes` marks the axes of a mesh along which their results vary, inside `shard_map`.
"""
