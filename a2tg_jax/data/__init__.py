"""Readers that turn input into a Scene: COLMAP, transforms.json, plain photographs, the built-in scene.

Names are imported at their first use. A program without photographs loads neither Pillow nor a COLMAP reader.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
