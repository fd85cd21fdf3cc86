"""Compositors behind the same two functions, made from the element-wise functions of `rasterize.pixel`.

- `choice` chooses a compositor: `native`, `pallas` or `xla`.
- `xla` composites with array operations on every device; tests compare the others with it.
- `native` composites and lists tiles in loops compiled for this CPU; `pallas` composites in kernels for GPUs.
- `packing` packs splats and texture regions into plain arrays, for both.
- `manual_axes` marks the axes of a mesh along which their results vary, inside `shard_map`.
"""
