"""The best picture for the bytes: every method at the same bytes, from few to many.

python experiments/equal_bytes.py --scenes SCENES --scale small --lpips-weights lpips_alex.npz
"""

from lab.cli import main
from lab.standard import quality_experiment

EXPERIMENT = quality_experiment("equal_bytes", "gaussians")

if __name__ == "__main__":
    main([EXPERIMENT], __doc__)
