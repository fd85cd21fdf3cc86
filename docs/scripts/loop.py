"""Write the loop of README.md: a model seen from an arc of its turntable, there and back, as an animated WebP.

python docs/scripts/loop.py MODEL docs/images/loop.webp
"""

import pathlib
import sys

import numpy as np
from PIL import Image

import a2tg_jax as a2tg
from a2tg_jax.results.images import save_animation, to_uint8

FROM, TO = -55.0, 85.0
"""Ends of the arc in degrees; 0 is the view of the most central camera."""
NUM_FRAMES = 37
FRAMES_PER_SECOND = 12
QUALITY = 72


def main(model: pathlib.Path, out: pathlib.Path, num_frames: int = NUM_FRAMES) -> None:
    """Render the frames and write them."""
    found = a2tg.load_model(model)
    assert found.origin is not None
    draw = a2tg.Renderer(found)
    ring = a2tg.turntable(found.origin.cameras, 360)
    # Slow at both ends, where it turns.
    shares = (1 - np.cos(np.pi * np.arange(num_frames) / (num_frames - 1))) / 2
    degrees = np.rint(FROM + (TO - FROM) * shares).astype(int)
    frames = [Image.fromarray(to_uint8(draw(ring[angle % 360]).color)) for angle in degrees]
    save_animation(out, iter(frames + frames[-2:0:-1]), FRAMES_PER_SECOND, quality=QUALITY, method=6)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]))
