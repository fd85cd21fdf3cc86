"""Drawings of docs/how-it-works.md, computed by the library's own functions.

python docs/scripts/drawings.py docs/images
"""

import dataclasses
import pathlib
import sys

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse, Rectangle

import a2tg_jax as a2tg
from a2tg_jax.core.gaussians import floats_per_gaussian
from a2tg_jax.rasterize.pixel import absorb
from a2tg_jax.texture import BYTES_PER_TEXEL

BLUE = "#3b6fb6"
ORANGE = "#e07b39"
GREEN = "#4f9d5d"
GREY = "#8a8a8a"
PURPLE = "#8c6bb1"
EXTENT = a2tg.TextureOptions().extent


def main(folder: pathlib.Path, dpi: int = 100) -> None:
    """Write the four drawings as PNG files."""
    drawings = {"splat": draw_splat, "ray": draw_ray, "growth": draw_growth, "bytes": draw_bytes}
    for name, draw in drawings.items():
        figure = draw()
        figure.savefig(folder / f"how-{name}.png", dpi=dpi, metadata={"Software": None})
        plt.close(figure)


def draw_splat() -> plt.Figure:
    """A Gaussian, its texture and both together, in its (u, v) plane."""
    # One Gaussian of unit scales that faces a camera far away, so that a pixel's ray hits it nearly at right angles.
    color = jnp.array([0.35, 0.5, 0.75])
    sh = ((color - 0.5) / 0.28209479177387814)[None, None]
    quats = jnp.array([[1.0, 0, 0, 0]])
    gaussian = a2tg.Gaussians(jnp.zeros((1, 3)), quats, jnp.zeros((1, 2)), jnp.full(1, 6.0), sh)
    texels = np.zeros((4, 4, 4), np.float32)
    texels[..., 3] = 1
    texels[:, :2, :3] = (0.45, 0.1, -0.5)  # added to the colour: a brown left half
    texels[2:, 2:, 3] = 0.1  # factor of opacity: the lower right quarter is almost transparent
    fov = 2 * np.degrees(np.arctan(3.4 / 60))
    camera = a2tg.look_at([0, 0, -60], [0, 0, 0], up=[0, -1, 0], width=160, height=160, fov=fov)
    white = jnp.ones(3)
    plain = a2tg.render_image(gaussian, camera, background=white).color
    textures = a2tg.textures_from_arrays([texels])
    both = a2tg.render_image(gaussian, camera, textures, background=white).color

    figure, panels = plt.subplots(1, 3, figsize=(9, 3.4), layout="constrained")
    bounds = (-3.4, 3.4, 3.4, -3.4)
    panels[0].imshow(plain, extent=bounds)
    for radius in (1, 2, 3):
        panels[0].add_patch(plt.Circle((0, 0), radius, fill=False, color=GREY, lw=0.8, ls=":"))
        panels[0].text(0, -radius + 0.05, f"{radius}σ", color="#333333", fontsize=8, ha="center", va="bottom")
    shown = np.clip(np.asarray(color) + texels[..., :3], 0, 1)
    rgba = np.concatenate([shown, np.clip(texels[..., 3:], 0, 1)], axis=-1)
    panels[1].imshow(rgba, extent=(-EXTENT, EXTENT, EXTENT, -EXTENT), interpolation="nearest")
    centers = (np.arange(4) + 0.5) / 4 * 2 * EXTENT - EXTENT
    panels[1].plot(*(each.ravel() for each in np.meshgrid(centers, centers)), "k+", ms=5)
    panels[2].imshow(both, extent=bounds)
    titles = ("Gaussian", "texture of 4×4 texels", "rendered together")
    for panel, title in zip(panels, titles, strict=True):
        panel.add_patch(Rectangle((-EXTENT, -EXTENT), 2 * EXTENT, 2 * EXTENT, fill=False, color=ORANGE, lw=1.2))
        panel.set(title=title, xlabel="u (standard deviations)", xlim=bounds[:2], ylim=bounds[2:])
        panel.set(xticks=range(-3, 4), yticks=range(-3, 4), aspect="equal")
    panels[0].set(ylabel="v")
    return figure


def draw_ray() -> plt.Figure:
    """A ray through three Gaussians, seen from the side, and the weights of their colours."""
    figure, (side, bars) = plt.subplots(1, 2, figsize=(9, 3.3), layout="constrained", width_ratios=(2, 1))
    alphas = np.array([0.5, 0.6, 0.8])
    colors = (BLUE, ORANGE, GREEN)
    slope = 0.12
    side.plot([0, 9.4], [0, 9.4 * slope], color="#333333", lw=1.2)
    side.plot(0, 0, "ks", ms=8)
    side.text(0, -0.28, "camera", ha="center", va="top")
    side.plot([1.2, 1.2], [-0.8, 0.8], color=GREY, lw=2)
    side.text(1.2, -0.9, "image plane", ha="center", va="top")
    side.plot(1.2, 1.2 * slope, "o", color="#333333", ms=5)
    side.annotate("pixel", (1.2, 1.2 * slope), (0.45, 0.75), arrowprops={"arrowstyle": "-", "color": GREY})
    places = ((3.4, 0.2, 80), (5.6, 0.95, 125), (8.0, 0.75, 65))  # centre and direction in degrees
    for number, ((x, y, degrees), color) in enumerate(zip(places, colors, strict=True), 1):
        along = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        hit = np.linalg.solve(np.column_stack([[1, slope], -along]), [x, y])
        # Line width follows the falloff of a Gaussian with a standard deviation of 0.35 along its plane.
        for start in np.linspace(-3, 2.9, 60):
            ends = np.array([x, y])[:, None] + 0.35 * along[:, None] * np.array([start, start + 0.11])
            side.plot(*ends, color=color, lw=1 + 7 * np.exp(-(start**2) / 2), solid_capstyle="butt")
        side.plot(hit[0], hit[0] * slope, "o", color="white", mec="#333333", ms=6, zorder=5)
        side.text(x, y - 1.35, f"Gaussian {number}\nα = {alphas[number - 1]}", ha="center", va="top", color=color)
    side.text(9.5, 9.4 * slope, "ray", va="center")
    side.set(xlim=(-0.6, 10), ylim=(-1.75, 2.1), aspect="equal")
    side.axis("off")

    left = 1.0
    weights = []
    for alpha in alphas:
        weight, left, _ = absorb(jnp.asarray(alpha), jnp.asarray(left), jnp.asarray(True))
        weights.append(float(weight))
    names = (*(f"Gaussian {number}" for number in (1, 2, 3)), "background")
    values = (*weights, float(left))
    drawn = bars.barh(names, values, color=(*colors, GREY))
    bars.bar_label(drawn, [f"{value:.2f}" for value in values], padding=3)
    bars.invert_yaxis()
    bars.set(title="weight in the pixel", xlim=(0, 0.62))
    bars.spines[["top", "right"]].set_visible(False)
    return figure


def draw_growth() -> plt.Figure:
    """Two upscalings of three textures: round, elongated, and without a large gradient."""
    upscale = a2tg.Upscale()
    # Standard deviations in units of the world, with a shorter one below k_s in the middle.
    scales = np.array([[0.02, 0.02], [0.04, 0.008], [0.02, 0.02]])
    gradients = np.array([3.0, 2.0, 0.1])
    sizes = [np.ones((3, 2), np.int64)]
    for _ in range(2):
        proposed = a2tg.next_sizes(sizes[-1], scales, k_a=upscale.k_a, k_s=upscale.k_s, cap=upscale.cap)
        grows = a2tg.select(gradients, sizes[-1], proposed, fraction=2 / 3)
        sizes.append(np.where(grows[:, None], proposed, sizes[-1]))
    names = ("large gradient,\nround", "large gradient,\nlong and thin", "small gradient")
    titles = ("start", "after one upscaling", "after two")
    figure, panels = plt.subplots(3, 3, figsize=(9, 3.9), layout="constrained")
    for row in range(3):
        for column in range(3):
            _draw_grid(panels[row, column], scales[row] / scales.max(), sizes[column][row])
        panels[row, 0].text(-5.6, 0, names[row], ha="center", va="center")
    for panel, title in zip(panels[0], titles, strict=True):
        panel.set_title(title)
    return figure


def _draw_grid(panel: Axes, scales: np.ndarray, size: np.ndarray) -> None:
    """Draw the ellipse of one standard deviation and the texels over ±3, of a Gaussian whose sizes are (Tv, Tu)."""
    half = EXTENT * scales
    for factor, alpha in ((2, 0.15), (1.5, 0.15), (1, 0.35)):
        panel.add_patch(Ellipse((0, 0), *(2 * factor * scales), color=BLUE, alpha=alpha, lw=0))
    for axis, number in enumerate(size[::-1]):
        for at in np.linspace(-half[axis], half[axis], number + 1):
            line = [[at, at], [-half[1 - axis], half[1 - axis]]]
            panel.plot(*(line if axis == 0 else line[::-1]), color=ORANGE, lw=1.3)
    rows, columns = size
    text = f"{rows}×{columns}, {BYTES_PER_TEXEL * rows * columns} bytes"
    panel.text(0, -half[1] - 0.15, text, ha="center", va="top", fontsize=9)
    panel.set(xlim=(-6.8, 3.6), ylim=(-2.3, 1.65), aspect="equal")
    panel.axis("off")


def draw_bytes() -> plt.Figure:
    """Bytes of a Gaussian, by what they are spent on, in several systems."""
    rows = {
        "degree 0": (0, 0, False),
        "degree 3": (3, 0, False),
        "degree 3, texture 2×2": (3, 2, False),
        "degree 3, texture 4×4": (3, 4, False),
        "bytewise: most Gaussians": (0, 0, True),
        "bytewise: degree 3, texture 2×2": (3, 2, True),
    }
    parts = {
        "position, axes, opacity": BLUE,
        "colour": GREEN,
        "kernel shape": PURPLE,
        "view dependence": GREY,
        "texture": ORANGE,
    }
    figure, panel = plt.subplots(figsize=(9, 3.2), layout="constrained")
    names = list(rows)
    table = np.array([_bytes_of(*row) for row in rows.values()])
    starts = np.zeros(len(rows))
    for (part, color), widths in zip(parts.items(), table.T, strict=True):
        panel.barh(names, widths, left=starts, color=color, label=part)
        starts += widths
    for name, total in zip(names, starts, strict=True):
        panel.text(total + 5, name, f"{total:.0f}", va="center")
    panel.invert_yaxis()
    panel.set(xlabel="bytes per Gaussian", xlim=(0, 540))
    panel.legend(loc="upper right")
    panel.spines[["top", "right"]].set_visible(False)
    return figure


def _bytes_of(degree: int, side: int, has_shape: bool) -> tuple[int, int, int, int, int]:
    """Return the bytes of geometry, colour, kernel shape, view dependence and texture; a model has as many."""
    gaussians = a2tg.init_from_points(np.eye(3), np.ones((3, 3)), sh_degree=degree)
    exponents = a2tg.allocate_appearance(a2tg.Appearance(exponents=a2tg.Exponents()), jax.random.key(0), gaussians)
    appearance = exponents if has_shape else a2tg.Appearance()
    if side:
        texture = a2tg.Texture(a2tg.allocate_textures([(side, side)] * 3))
        appearance = dataclasses.replace(appearance, texture=texture)
    color = 4 * 3
    geometry = 4 * floats_per_gaussian(0) - color
    found = (geometry, color, 4 * has_shape, 4 * (floats_per_gaussian(degree) - floats_per_gaussian(0)), 16 * side**2)
    total = a2tg.Model(gaussians, appearance).num_bytes
    if 3 * sum(found) != total:
        raise AssertionError(f"three Gaussians have {3 * sum(found)} bytes by parts, but the model has {total}")
    return found


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
