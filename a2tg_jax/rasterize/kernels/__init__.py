"""Compositors, all behind the same two functions, made from the element-wise functions of `rasterize.pixel`.

- `choice` says which compositor runs where: `native`, `pallas` or `xla`.
- `xla` composites with array operations, on every device; the others are compared with it.
- `native` composites and lists tiles in loops compiled for this CPU; `pallas` composites in kernels for GPUs.
- `packing` lays splats and texture regions out as plain arrays, for both.
- `manual_axes` says along which axes of a mesh their results vary, inside `shard_map`.
"""
