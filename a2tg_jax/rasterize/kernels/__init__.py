"""Compositors behind the same functions, made from the element-wise functions of `rasterize.pixel`."""
