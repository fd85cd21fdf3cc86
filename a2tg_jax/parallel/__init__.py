"""Several devices and processes that train one scene. The rest of the package mainly uses rows and exchange.

- `sharded_rows`: who holds which rows of Gaussians, and how the host reads and writes them.
- `exchange`: how splats reach the pixels that need them; `exchange_room`: how much room that takes.
- `processes`: several processes join, watch each other, and leave.
"""
