"""GPU kernels of tiles: the functions of a pixel printed as C, compiled by NVRTC, launched by XLA."""
