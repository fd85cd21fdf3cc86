"""Trains on one, two and four devices of a CPU and compares; run by `test_devices` in a process of its own.

python tests/on_devices.py gradients|lenses|training|events|memory… FOLDER
"""

import dataclasses
import functools
import sys
import traceback
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import fisheye
from test_shared import Own

import a2tg_jax as a2tg
from a2tg_jax import Change, Gaussians2dMcmc, HostEvent, Session, SplitByGradient, StepEvent, fit_stage
from a2tg_jax.parallel import whole
from a2tg_jax.training import loop
from a2tg_jax.training.batches import PhotoStore
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.start import initial_model, padded
from a2tg_jax.training.step import attempt, jitted_step

ROWS = 96
"""Number of Gaussians: divisible by 4."""


@functools.cache
def scene():
    return a2tg.synthetic_scene(num_views=9, width=72, height=54, num_points=ROWS)


def plain():
    found = scene()
    return a2tg.Model(a2tg.init_from_points(found.points, found.colors, sh_degree=1, opacity=0.6))


def textured():
    """Textures of two sizes, of which every third Gaussian has the larger one: 4 divides neither number."""
    model = plain()
    sizes = np.where(np.arange(ROWS)[:, None] % 3 == 0, [[2, 4]], [[1, 1]])
    textures = a2tg.allocate_textures(sizes[:ROWS], rgb=0.1)
    buckets = [texels * jnp.linspace(0.2, 1.0, texels.size).reshape(texels.shape) for texels in textures.buckets]
    textures = dataclasses.replace(textures, buckets=tuple(buckets))
    return a2tg.Model(model.gaussians, a2tg.Appearance(texture=a2tg.Texture(textures)))


def behind_lenses(found):
    """A scene behind two fisheyes, whose corner has no rays; the second one's focal length is a tenth longer."""
    corner = np.add.outer(np.arange(54), np.arange(72)) < 20
    shared = {}

    def kept(index, view):
        longer = 1.1 if index % 3 == 0 else 1.0
        if longer not in shared:
            K = view.camera.K * jnp.asarray([[longer], [longer], [1.0]])
            rays = fisheye(dataclasses.replace(view.camera, K=K)).rays
            shared[longer] = K, np.asarray(jnp.where(corner[..., None], jnp.nan, rays))
        K, rays = shared[longer]
        camera = dataclasses.replace(view.camera, K=K, rays=rays)
        return dataclasses.replace(view, camera=camera, mask=None)

    return dataclasses.replace(found, train=tuple(kept(index, view) for index, view in enumerate(found.train)))


def system(kind, **options):
    return kind.preset("smoke", **{"initial_gaussians": ROWS, "seed": 3, "batch_size": 4, **options})


def devices(count):
    return Session(devices=jax.devices()[:count] if count > 1 else None)


def attempted(found, own, index, start, count, is_streamed=False):
    """Losses, gradients of all views and their means, and the model after the first step, as NumPy arrays."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "PhotoStore", functools.partial(PhotoStore, room=0 if is_streamed else None))
        run = StageRun(found, own, index, start, session=devices(count))
    assert run.photographs.is_resident != is_streamed
    tried = whole(jax.jit(attempt, static_argnums=(0,))(*run.arguments(1)))
    run.photographs.close()
    return tried.views, tried.grads, tried.state.model


def close(expected, found, tolerance):
    """Floats agree, relative to the largest of their array; all else is equal."""
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        a = np.asarray(a)
        b = np.asarray(b)
        if a.dtype.kind == "f":
            np.testing.assert_allclose(b, a, rtol=0, atol=tolerance * max(np.abs(a).max(), 1e-9))
        else:
            np.testing.assert_array_equal(a, b)


def gradients(folder):
    """A step on 2 and 4 devices has the gradients of one device, with textures, exposures and a statistic."""
    own = system(a2tg.A2tg, densify={"cap": ROWS}, exposure=True)
    alone = attempted(scene(), own, 1, textured(), 1)
    assert all(float(np.abs(leaf).max()) > 0 for leaf in jax.tree.leaves(alone[1]))
    for count, is_streamed in ((2, True), (4, False)):
        close(alone, attempted(scene(), own, 1, textured(), count, is_streamed), 1e-6)


def lenses(folder):
    """And behind two lenses, of which each device has the rays, in a system that splits by gradients."""
    own = system(a2tg.A2tg, densify={"cap": 0}, batch_size=8)
    found = behind_lenses(scene())
    close(attempted(found, own, 0, plain(), 1), attempted(found, own, 0, plain(), 4), 1e-6)


def psnr_of(result):
    return a2tg.evaluate(scene().test, result.model).psnr


def fit(own, count, **options):
    return a2tg.fit(scene(), own, session=devices(count), **options)


def training(folder):
    """The same devices give the same bits when resumed; other numbers of them end with the same quality."""
    own = system(Gaussians2dMcmc, stage1_iterations=24, densify={"cap": 152}, batch_size=12)
    path, path_alone = (Path(folder) / name for name in ("together.npz", "alone.npz"))

    def keeping(path):
        return lambda found: found.iteration == 12 and a2tg.save_checkpoint(path, found)

    together = fit(own, 4, on_checkpoint=keeping(path), checkpoint_every=12)
    assert len(together.model.gaussians.means.devices()) == 1, "results are on one device"
    alone = fit(own, 1, on_checkpoint=keeping(path_alone), checkpoint_every=12)
    end = psnr_of(alone)
    assert abs(psnr_of(together) - end) < 0.02
    for count, start in ((4, path), (3, path_alone)):
        with warnings.catch_warnings(record=True) as printed:
            warnings.simplefilter("always")
            again = fit(own, count, resume=a2tg.load_checkpoint(start))
        assert any("152 rows, which 3 devices cannot share" in str(one.message) for one in printed) == (count == 3)
        assert again.model.num == alone.model.num and abs(psnr_of(again) - end) < 0.02, count
        if count == 4:
            np.testing.assert_array_equal(together.model.gaussians.means, again.model.gaussians.means)
    with pytest.raises(
        ValueError, match=r"batch_size must be a multiple of the 4 devices.*got 6: .* or 1 or 2 or 3 of"
    ):
        fit(dataclasses.replace(own, batch_size=6), 4)


def textures(folder):
    """Textures grow as on one device; rows that do not divide evenly are filled up."""
    own = system(a2tg.A2tg, densify={"cap": 118}, texture={"at": (0.5,)}, stage2_iterations=8)
    alone, together = (fit_stage(scene(), own, 1, plain(), session=devices(count)) for count in (1, 4))
    assert alone.model.num == together.model.num and alone.model.num_bytes == together.model.num_bytes
    assert together.model.appearance.textures.sizes.max() > 1, "textures have grown"
    assert abs(psnr_of(alone) - psnr_of(together)) < 0.02
    assert padded(plain(), own.stages()[0], own, 4).gaussians.num == 120


def assert_divided(state):
    """Floats are divided where they can be; all else is whole on each device."""
    for leaf in jax.tree.leaves(state):
        is_divided = leaf.ndim > 0 and leaf.size and leaf.shape[0] % 4 == 0 and leaf.dtype.kind == "f"
        assert len(leaf.sharding.device_set) == 4
        assert leaf.is_fully_replicated != bool(is_divided), (leaf.shape, leaf.dtype, leaf.sharding)


@a2tg.pytree
class Reverse(HostEvent):
    """A custom event that reverses the order of the rows, by JAX and by NumPy."""

    def times(self, num_iterations):
        return (2,)

    def apply(self, due, model, moments, state):
        places = np.arange(model.gaussians.num)[::-1]
        gaussians = jax.tree.map(lambda x: x[places], model.gaussians)
        gaussians = dataclasses.replace(gaussians, means=np.asarray(model.gaussians.means)[places])
        return Change(dataclasses.replace(model, gaussians=gaussians), moments, state, rows=places)


@a2tg.pytree
class Remember(StepEvent):
    """A custom event whose state is made of values of the model."""

    def init(self, model):
        return jnp.asarray(model.gaussians.means)[:, 0]

    def apply(self, now, model, moments, state):
        return Change(model, moments, state)


@a2tg.pytree
class LateSplits(SplitByGradient):
    """It gathers its statistic up to iteration 4."""

    def times(self, num_iterations):
        return (4,)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reversed(a2tg.System):
    name = "reversed"

    def stages(self):
        events = LateSplits(ROWS), Reverse(), Remember()
        return (a2tg.Stage("gaussians", a2tg.Appearance(), events, self.loss.terms(), self.rates, 4),)


def events(folder):
    """Events on the host read whole arrays; what they return is divided again."""
    run = StageRun(scene(), Reversed(sh_degree=1, initial_gaussians=ROWS, batch_size=4), 0, plain(), session=devices(4))
    run.steps(1, 2)
    before = run.whole_state
    assert len(np.unique(before.events[0].gradients.total)) > 20 and len(np.unique(before.events[2])) > 20
    run.apply_events(2)
    after = run.whole_state
    np.testing.assert_array_equal(after.model.gaussians.means, before.model.gaussians.means[::-1])
    np.testing.assert_array_equal(after.events[0].gradients.total, before.events[0].gradients.total[::-1])
    np.testing.assert_array_equal(after.events[2], before.events[2][::-1])
    assert_divided(run.state)
    run.photographs.close()


def details(folder):
    """A system that prunes, places Gaussians, raises degrees and lets textures grow trains to its end."""
    own = system(
        a2tg.Bytewise, densify={"cap": 120}, stage1_iterations=20, stage2_iterations=20,
        prune={"share": 0.3, "at": (0.2,)}, place={"at": (0.2,)}, floaters={"min_views": 3, "at": (0.4,)},
        view_dependence_share=0.2, view_dependence={"at": (0.2,)}, texture_share=0.2, details={"at": (0.4,)},
    )  # fmt: skip
    alone, together = (fit(own, count) for count in (1, 4))
    assert together.model.num == alone.model.num
    assert abs(psnr_of(alone) - psnr_of(together)) < 0.05


def shared(folder):
    """What Gaussians share learns as on one device."""
    own = dataclasses.replace(Own(events="splitting", sh_degree=0, stage1_iterations=12), batch_size=4)
    networks = []
    for count in (1, 4):
        fit(own, count, on_checkpoint=lambda checkpoint: networks.append(checkpoint.state.model.appearance.network))
    alone, together = (jax.tree.map(np.asarray, network) for network in networks)
    close(alone, together, 1e-4)


def memory(folder):
    """A device has its share of parameters and moments."""
    found = a2tg.synthetic_scene(num_views=5, width=48, height=36, num_points=4000)
    own = system(Gaussians2dMcmc, densify={"cap": 4000}, initial_gaussians=4000)
    run = StageRun(found, own, 0, initial_model(found, own), session=devices(4))
    arguments = run.arguments(1)
    said = jitted_step().lower(*arguments).compile().memory_analysis()
    model_bytes = run.model.num_bytes
    rest = sum(leaf.nbytes for leaf in jax.tree.leaves(arguments[2].photographs))
    assert said.argument_size_in_bytes < 3 * model_bytes / 4 + rest + 10_000
    run.photographs.close()


def main(names, folder):
    """Run each of the functions, whatever became of those before; the exit status is the number of those that fail."""
    num_failed = 0
    for name in names:
        try:
            globals()[name](folder)
        except Exception:
            num_failed += 1
            print(f"{name}\n{traceback.format_exc()[-3000:]}", file=sys.stderr)
    sys.exit(num_failed)


if __name__ == "__main__":
    main(sys.argv[1:-1], sys.argv[-1])
