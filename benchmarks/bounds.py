"""Bounds on paper of the stages of a training step on an H200: no stage can take less time than its traffic and its
arithmetic.

    python -m benchmarks.bounds --out benchmarks/results/bounds.json
    python -m benchmarks.tables benchmarks/results/bounds.json docs/performance.md

Splats, pairs and pixels of the random workload are counted on the CPU, at the real size. Bytes are those that must
reach memory if every array is read or written once, a pass of a sort twice; operations are the primitives of the jaxprs
that the kernels are printed from, one each. Atomic sums are bytes too, as if none of them hit the cache.
"""

import argparse
import dataclasses
import json
import math
import pathlib

import jax
import jax.numpy as jnp
import numpy as np

import a2tg_jax
from a2tg_jax.core.bilinear import TextureRegion
from a2tg_jax.core.gaussians import floats_per_gaussian
from a2tg_jax.rasterize.compositor import composite
from a2tg_jax.rasterize.kernels.jaxprs import PixelFunctions
from a2tg_jax.rasterize.kernels.native import composite as native
from a2tg_jax.rasterize.splats import PassSettings, Splats, project_gaussians, settings_of_pass
from a2tg_jax.rasterize.tiles import TileGrid, TileLists
from a2tg_jax.rasterize.views import capacity_for, pairs_of_view
from a2tg_jax.render import appearance_of
from benchmarks.workload import random_scene, random_textures

BYTES_PER_SECOND, FLOPS_PER_SECOND = 4.8e12, 67e12
"""Peaks of an H200: memory, and float32 outside of tensor cores, where a multiply-add counts as two."""
NUMBERS, KINDS = (100_000, 500_000, 1_000_000), ("none", "mixed")
FULL_SIZE, TILE_SIZE = (1600, 1060), 16
FLOAT = 4
RADIX_BITS = 8
"""Bits that one pass of a radix sort orders by."""
ADAM_FLOPS = 15
SSIM_FLOPS = (5 + 3) * 2 * 11 * 2 * 3
"""Operations of a pixel: eleven taps along each axis of five maps of three colours, and of three maps back."""
SAMPLE = 1_024
"""Gaussians that projection is traced with."""


@dataclasses.dataclass(frozen=True)
class Work:
    """Counts of the kernels' work in a view."""

    num: int
    num_pixels: int
    boxes: float
    """Pairs of a splat and a tile before the outline test."""
    listed: float
    """Pairs in the lists."""
    taken: float
    """Pairs until all pixels of the tile are opaque."""
    composited: float
    """Pairs of a splat and a pixel that are composited."""
    textured: float
    """Pairs of splats with more than one texel."""
    num_texels: int


@dataclasses.dataclass(frozen=True)
class Stage:
    """Least work of a stage."""

    name: str
    bytes: float
    flops: float
    atomics: float = 0.0
    """Bytes that atomic sums read and write."""

    @property
    def told(self) -> dict:
        """Milliseconds of each kind of work, for JSON."""
        by_bytes, by_flops = 1e3 * self.bytes / BYTES_PER_SECOND, 1e3 * self.flops / FLOPS_PER_SECOND
        by_atomics = 1e3 * self.atomics / BYTES_PER_SECOND
        found = {"bytes": by_bytes, "flops": by_flops, "atomics": by_atomics}
        return {"stage": self.name, **{name: round(value, 4) for name, value in found.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("bounds.json"))
    parser.add_argument("--numbers", type=int, nargs="+", default=NUMBERS, help="numbers of Gaussians")
    parser.add_argument("--size", type=int, nargs=2, default=FULL_SIZE, metavar=("WIDTH", "HEIGHT"))
    args = parser.parse_args()
    a2tg_jax.configure_cpu()
    found = []
    for num in args.numbers:
        for kind in KINDS:
            work, spec = count(num, kind, *args.size)
            told = [stage.told for stage in stages(work, spec)]
            found.append({"textures": kind, **dataclasses.asdict(work), "stages": told})
            print(found[-1], flush=True)
            args.out.write_text(json.dumps({"bounds": found}, indent=1) + "\n")


def count(num: int, kind: str, width: int, height: int) -> tuple[Work, PassSettings]:
    """Count the work of the random workload's view, and return the specification of its kernels."""
    gaussians, camera = random_scene(num, width, height)
    textures = random_textures(num, kind)
    settings = a2tg_jax.RenderSettings(tile_size=TILE_SIZE)
    appearance, grid = appearance_of(gaussians, textures, settings), TileGrid(width, height, TILE_SIZE)
    boxes = pairs_of_view(gaussians, camera, appearance, settings)
    splats, cutoff = jax.jit(lambda g: project_gaussians(g, camera, appearance, settings.near_plane, 3))(gaussians)
    lists = native.tile_lists(splats.M, cutoff, settings.near_plane, grid, capacity_for(boxes))
    compositing, texels, regions = settings_of_pass(
        appearance, splats, grid, settings.near_plane, has_geometry=False, compositor="native", tile_batch=1
    )
    counting = compositing._replace(statistic="position")
    jacobian = camera.K @ camera.viewmat[:3, :3]
    view = View(counting, splats, texels, regions, cutoff, jacobian)
    counts = np.asarray(view.counts(lists))
    areas = np.zeros(num, int) if textures is None else textures.sizes.prod(axis=1)
    work = Work(
        num, width * height, float(boxes), float(lists.starts[-1]), float(view.taken(lists).sum()), float(counts.sum()),
        float(counts[areas > 1].sum()), int(areas.sum()),
    )  # fmt: skip
    return work, compositing.kernel


@dataclasses.dataclass(frozen=True)
class View:
    """A view to composite with different tile lists."""

    settings: PassSettings
    splats: Splats
    texels: jax.Array
    regions: TextureRegion | None
    cutoff: jax.Array
    jacobian: jax.Array

    def counts(self, lists: TileLists) -> jax.Array:
        """Return the number of pixels in which each splat is composited."""

        def total(probe: jax.Array) -> jax.Array:
            return sum(jnp.sum(x) for x in self._composite(lists, probe))

        return jax.jit(jax.grad(total))(jnp.zeros((len(self.cutoff), 4)))[:, 3]

    def taken(self, lists: TileLists) -> np.ndarray:
        """Return the length of the shortest beginning of each tile's list that shows all that the list shows."""
        shown = jax.jit(lambda lists: self._by_tile(self._composite(lists, jnp.zeros((len(self.cutoff), 4)))[1]))
        ids, starts, wanted = np.asarray(lists.ids), np.asarray(lists.starts), shown(lists)
        least, most = np.zeros(self.settings.grid.num, np.int64), np.diff(starts).astype(np.int64)
        while (least < most).any():
            tried = (least + most) // 2
            is_enough = np.asarray(jnp.all(shown(beginning(lists, ids, starts, tried)) == wanted, axis=1))
            least, most = np.where(is_enough, least, np.minimum(tried + 1, most)), np.where(is_enough, tried, most)
        return least

    def _composite(self, lists: TileLists, probe: jax.Array) -> tuple[jax.Array, jax.Array]:
        given = self.splats, self.texels, self.regions, self.cutoff, lists, self.jacobian, probe
        return composite(self.settings, *given)

    def _by_tile(self, image: jax.Array) -> jax.Array:
        """Return an image [H, W] as [tiles, pixels of a tile], padded with zeros."""
        grid = self.settings.grid
        side, (height, width) = grid.tile_size, image.shape
        padded = jnp.pad(image, ((0, grid.rows * side - height), (0, grid.columns * side - width)))
        blocks = padded.reshape(grid.rows, side, grid.columns, side).swapaxes(1, 2)
        return blocks.reshape(grid.num, side * side)


def beginning(lists: TileLists, ids: np.ndarray, starts: np.ndarray, lengths: np.ndarray) -> TileLists:
    """Return lists of the first splats of each tile."""
    ends = np.concatenate([[0], np.cumsum(lengths)])
    place = np.arange(ends[-1]) + np.repeat(starts[:-1] - ends[:-1], lengths)
    kept = np.zeros_like(ids)
    kept[: ends[-1]] = ids[place]
    return lists._replace(ids=jnp.asarray(kept), starts=jnp.asarray(ends, jnp.int32))


def stages(work: Work, spec: PassSettings) -> list[Stage]:
    """Return the least work of each stage of a step."""
    num, row, size = work.num, FLOAT * spec.num_floats, FLOAT * floats_per_gaussian(3)
    texels, image = FLOAT * spec.num_columns * work.num_texels, FLOAT * 3 * work.num_pixels
    functions, evaluated = PixelFunctions(spec), work.taken * TILE_SIZE**2
    prepare, reach, blend = (operations(jaxpr) for jaxpr in (functions.prepare, functions.reach, functions.forward))
    back, prepare_back = operations(functions.backward), operations(functions.prepare_vjp)
    project, project_back = projection_flops()
    lists_read = FLOAT * work.taken + row * num + texels
    forward = work.taken * prepare + evaluated * reach + work.composited * blend
    backward = work.taken * (prepare + prepare_back) + evaluated * reach + work.composited * (back + spec.num_floats)
    sums = 2 * FLOAT * (work.taken * (spec.num_floats - 1) + work.textured * 4 * spec.num_columns)
    return [
        Stage("projection", num * (size + row), num * project),
        Stage("tile lists", sort_bytes(work), 0),
        Stage("compositing", lists_read + image + image / 3, forward),
        Stage("loss and its gradient", 3 * image, SSIM_FLOPS * work.num_pixels),
        Stage("compositing, backward", lists_read + row * num + texels + 2 * image, backward, sums),
        Stage("projection, backward", num * (2 * size + row), num * project_back),
        Stage("Adam", 7 * (num * size + texels), ADAM_FLOPS * (num * size + texels) / FLOAT),
    ]


def sort_bytes(work: Work) -> float:
    """Return the bytes that two radix sorts move: splats by depth, and pairs by tile and rank."""
    tile_bits = (-(-FULL_SIZE[0] // TILE_SIZE) * -(-FULL_SIZE[1] // TILE_SIZE)).bit_length()
    is_packed = tile_bits + (work.num - 1).bit_length() <= 32
    passes, entry = (4, FLOAT) if is_packed else (2, FLOAT + 2)
    assert passes == math.ceil((32 if is_packed else 16) / RADIX_BITS)
    return 2 * (4 * 2 * FLOAT * work.num + passes * entry * work.boxes) + 2 * FLOAT * work.listed


def operations(jaxpr) -> int:
    """Return the number of arithmetic primitives of a jaxpr of scalars, calls followed."""
    total = 0
    for equation in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        inner = [value for value in equation.params.values() if hasattr(value, "eqns") or hasattr(value, "jaxpr")]
        is_arithmetic = equation.primitive.name not in MOVES and not inner
        total += sum(map(operations, inner)) + is_arithmetic * int(np.prod(equation.outvars[0].aval.shape))
    return total


MOVES = {
    "broadcast_in_dim", "convert_element_type", "copy", "reshape", "slice", "squeeze", "stop_gradient", "transpose",
    "concatenate", "stack",
}  # fmt: skip
"""Primitives that compute nothing."""


def projection_flops() -> tuple[float, float]:
    """Return the operations of projecting a Gaussian, and of the gradient of that, as XLA counts them."""
    gaussians, camera = random_scene(SAMPLE, *FULL_SIZE)
    plain = a2tg_jax.Appearance()
    project = lambda gaussians: project_gaussians(gaussians, camera, plain, 0.2, 3)[0]  # noqa: E731

    def pull_back(gaussians):
        splats, pull = jax.vjp(project, gaussians)
        return pull(splats)

    return tuple(jax.jit(f).lower(gaussians).cost_analysis()["flops"] / SAMPLE for f in (project, pull_back))


if __name__ == "__main__":
    main()
