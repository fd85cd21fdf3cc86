"""Several devices and processes that train one scene, met by the rest of the package at two seams.

- `rows`: who holds which rows of Gaussians, and how the host reads and writes them.
- `exchange`: how splats reach the pixels that need them.
"""
