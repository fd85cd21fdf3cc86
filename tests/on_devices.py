"""Renders and trains on one, two and four devices of a CPU and compares; run by `test_devices` in a process of its own.

python tests/on_devices.py rendering|xla|balance|overflowing|batches|lenses|training|textures|events|memory… FOLDER
"""

import contextlib
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
from a2tg_jax.parallel.exchange import AXIS, ROOM_OF_A_BAND, BorderRoom, ImageBands, exchange_among
from a2tg_jax.parallel.sharded_rows import on_host, placed_like, readable, rows_moved, sharding_of_rows, spread
from jax.sharding import PartitionSpec as P
from scenes_random import fisheye
from test_shared import Own

import a2tg_jax as a2tg
from a2tg_jax.core.budget import bytes_per_gaussian
from a2tg_jax.densify.splitting import SplitByGradient
from a2tg_jax.events import Change, Due, HostEvent, StepEvent
from a2tg_jax.io.config_json import changed_config
from a2tg_jax.parallel import exchange as exchanges, sharded_rows as rows
from a2tg_jax.rasterize.tiles import TileGrid
from a2tg_jax.rasterize.views import pairs_of_view, render_traced
from a2tg_jax.systems.baselines import Gaussians2dMcmc
from a2tg_jax.training import Session, fit_stage, loop
from a2tg_jax.training.batches import PhotoStore
from a2tg_jax.training.cost import stage_bytes
from a2tg_jax.training.divergence import spread_attempt
from a2tg_jax.training.loop import StageRun
from a2tg_jax.training.losses import normal_consistency
from a2tg_jax.training.start import initial_model, padded
from a2tg_jax.training.step import jitted_step

ROWS = 96
"""Number of Gaussians that are rendered: divisible by 4."""


@functools.cache
def scene():
    return a2tg.synthetic_scene(num_views=9, width=72, height=54, num_points=ROWS)


def plain():
    found = scene()
    return a2tg.Model(a2tg.init_from_points(found.points, found.colors, sh_degree=1, opacity=0.6))


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


def textured():
    """Textures of two sizes, of which every second Gaussian has the larger one."""
    model = plain()
    sizes = np.where(np.arange(ROWS)[:, None] % 2, [[2, 4]], [[1, 1]])
    textures = a2tg.allocate_textures(sizes, rgb=0.1)
    buckets = [texels * jnp.linspace(0.2, 1.0, texels.size).reshape(texels.shape) for texels in textures.buckets]
    textures = dataclasses.replace(textures, buckets=tuple(buckets))
    return a2tg.Model(model.gaussians, a2tg.Appearance(texture=a2tg.Texture(textures)))


def same_gradients(loss, model, camera, exchange, compositor="auto"):
    """Image, gradients and statistic are those of one device; returns the settings of one, and what several found."""
    settings = dataclasses.replace(a2tg.plan_render(model, [camera]), compositor=compositor)
    alone = a2tg.view_gradients(loss, model, camera, settings=settings)
    own = dataclasses.replace(settings, exchange=exchange)
    found = jax.jit(lambda m: a2tg.view_gradients(loss, m, camera, settings=own))(spread(exchange.mesh, model))
    assert not found.output.overflow and found.num_pairs > 0 and float(alone.output.alpha.max()) > 0.5
    close(alone._replace(num_pairs=0), found._replace(num_pairs=0))
    assert found.gradient.gaussians.means.sharding.spec[0] == "rows", "the gradient stays where its rows are"
    return settings, found


def rendering(folder):
    """The last band is partly outside the image."""
    view, exchange = scene().train[0], exchange_among(jax.devices())
    target = a2tg.view_image(view)

    def loss(model, output):
        return jnp.mean((output.color - target) ** 2) + 0.01 * jnp.mean(output.depth) + jnp.mean(output.distortion)

    same_gradients(loss, textured(), view.camera, exchange, "native")


def xla(folder):
    """The loops of XLA draw plain Gaussians as on one device."""
    loss = lambda model, output: jnp.mean(output.color**2) + 0.01 * jnp.mean(output.depth)  # noqa: E731
    same_gradients(loss, plain(), scene().train[0].camera, exchange_among(jax.devices()), "xla")


def upper_quarter(height=512):
    """A camera that shows the centres of all Gaussians in the upper quarter of a tall image."""
    camera = scene().train[0].camera
    squeezed = jnp.asarray(camera.K).at[1].multiply(0.25 * height / camera.height)
    return dataclasses.replace(camera, K=squeezed, height=height)


def balance(folder):
    """All devices have about as many pairs if the splats show in a quarter of the image, and draw what one does."""
    camera, exchange = upper_quarter(), exchange_among(jax.devices())
    any_bands_become_even(exchange)

    def loss(model, output):
        return jnp.mean(jnp.sin(output.color)) + 0.01 * jnp.mean(output.depth)

    settings, found = same_gradients(loss, textured(), camera, exchange)
    pairs = pairs_of_view(textured().gaussians, camera, textured().appearance, settings)
    assert found.num_pairs * ROOM_OF_A_BAND < 1.2 * pairs, "the fullest band has a fifth more than an even share"
    borders_without_room_overflow(exchange, camera)
    eager_renders_have_room(exchange)


def borders_without_room_overflow(exchange, camera):
    """The lists of a band whose borders moved too far stay within its tiles, and the overflow is told."""
    heights, listed = [], exchanges.list_tiles

    def watched(compositor, M, cutoff, near_plane, grid, capacity, pixels, height):
        jax.debug.callback(lambda own: heights.append((int(own), grid.height)), height)
        return listed(compositor, M, cutoff, near_plane, grid, capacity, pixels, height)

    own = dataclasses.replace(exchange, border_room=BorderRoom(0, 0))
    settings = dataclasses.replace(a2tg.plan_render(plain(), [camera]), compositor="native", exchange=own)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exchanges, "list_tiles", watched)
        draw = jax.jit(lambda gaussians: a2tg.render_image(gaussians, camera, settings=settings))
        output = draw(spread(own.mesh, plain().gaussians))
        jax.effects_barrier()
    assert bool(output.overflow)
    assert len(heights) == exchange.num and all(0 <= height <= most for height, most in heights), heights


def eager_renders_have_room(exchange):
    """A render without a capacity draws all splats, also if few rows of tiles show all of them."""
    camera = scene().train[0].camera
    flat = dataclasses.replace(camera, K=jnp.asarray(camera.K).at[1, 1].multiply(0.05))
    gaussians = plain().gaussians
    expected = a2tg.render_image(gaussians, flat)
    found = a2tg.render_image(spread(exchange.mesh, gaussians), flat, settings=a2tg.RenderSettings(exchange=exchange))
    assert not bool(found.overflow)
    close(expected.color, found.color)


def any_bands_become_even(exchange):
    """Pixels of bands with random borders, some of them empty, become the image: of one view, and of two at once."""
    rng, grid = np.random.default_rng(0), TileGrid(5, 101, 8)
    for num_views in (1, 2, 4):
        num = exchange.num // num_views
        cuts = np.sort(rng.integers(0, grid.rows + 1, (4, num_views, num - 1)), axis=-1)
        edges = ((0, 0), (0, 0), (1, 1))
        draws = np.pad(cuts, edges, constant_values=((0, 0), (0, 0), (0, grid.rows))).astype(np.int32)
        every = [ImageBands.of(grid, num).room_for(jnp.asarray(own)) for borders in draws for own in borders]
        bands = ImageBands.of(grid, num, BorderRoom(*np.max(every, axis=0).tolist()))

        def on_device(local, borders, bands=bands, num_views=num_views):
            index = jax.lax.axis_index(AXIS)
            return bands.to_even(local[0], borders[index // bands.num], index, num_views, AXIS)

        specs = {"in_specs": (P(AXIS), P()), "out_specs": P(None, AXIS)}
        evened = jax.jit(jax.shard_map(on_device, mesh=exchange.mesh, **specs, check_vma=False))
        for borders in draws:
            image = rng.random((num_views, 2, 101, 5))
            shown = [
                np.pad(image[view, :, top * 8 :], ((0, 0), (0, 101), (0, 0)), constant_values=np.nan)
                for view in range(num_views) for top in borders[view, :-1]
            ]  # fmt: skip
            found = np.asarray(evened(np.stack([own[:, : bands.own.height] for own in shown]), borders))
            found = found.reshape(2, num_views, -1, 5)[:, :, :101]
            np.testing.assert_array_equal(found.swapaxes(0, 1), image.astype(np.float32))


def close(expected, found):
    """Floats agree to 1e-5 of the largest of their array, all else is equal."""
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        if a.dtype.kind == "f":
            np.testing.assert_allclose(b, a, rtol=0, atol=3e-5 * max(np.abs(a).max(), 1e-9))
        else:
            np.testing.assert_array_equal(a, b)


def overflowing(folder):
    """Too little room for pairs, or for rows on their way, is said with the capacity that has it."""
    view, model, exchange = scene().train[0], plain(), exchange_among(jax.devices()[:4])
    enough = a2tg.plan_render(model, [view.camera]).capacity

    def printed(capacity, rows_per_pair):
        own = dataclasses.replace(exchange, rows_per_pair=rows_per_pair)
        settings = a2tg.RenderSettings(capacity=capacity, exchange=own)
        render = jax.jit(lambda m: render_traced(m.gaussians, view.camera, m.appearance, jnp.zeros(3), settings))
        output, num_pairs = render(spread(exchange.mesh, model))
        return bool(output.overflow), float(num_pairs)

    assert printed(enough, 1.0)[0] is False
    for rows_per_pair in (1.0, 4 / enough):
        is_overflow, needed = printed(64 if rows_per_pair == 1.0 else enough, rows_per_pair)
        assert is_overflow
        assert printed(int(np.ceil(needed)), rows_per_pair)[0] is False, "what is asked for is enough"
    borders_find_room()


def borders_find_room():
    """Training makes room for borders that move, and comes to the same bits as with enough room from the start."""
    own = system(Gaussians2dMcmc, densify={"cap": 0}, stage1_iterations=4)
    states = []
    for room in (None, BorderRoom(0, 0)):
        run = StageRun(scene(), own, 0, plain(), session=Session(devices=jax.devices()[:4]))
        (size,) = {view.picture.size for view in run.views}
        run.arguments(1)
        run.exchanges[size] = dataclasses.replace(
            run.exchanges[size], border_room=room or run.exchanges[size].border_room
        )
        capacity, taken = run.capacities[size], 0
        while taken < 4:
            taken += len(run.steps(taken + 1, 4))
        assert bool(run.num_regrown) == (room is not None) and run.capacities[size] == capacity
        states.append(run.model)
        run.photographs.close()
    for a, b in zip(*map(jax.tree.leaves, states), strict=True):
        np.testing.assert_array_equal(a, b)


def system(kind, **options):
    return changed_config(kind.preset("smoke"), {"initial_gaussians": ROWS, "seed": 3, **options}, "here")


def psnr_of(result):
    return a2tg.evaluate(scene().test, result.model).psnr


def fit(own, count, **options):
    return a2tg.fit(
        scene(), own, progress=False, session=Session(devices=jax.devices()[:count] if count > 1 else None), **options
    )


def batches(folder):
    """Views that are drawn at once, each by its share of the devices, have the gradients of one device."""
    own = system(a2tg.A2tg, densify={"cap": ROWS}, exposure=True)
    with same_attempts(scene(), dataclasses.replace(own, batch_size=6), 1, True) as (run, arguments):
        assert arguments[0].render.exchange.views_at_once == 2
        check_parts(arguments[4].images, [run.views[place].image for place in run.order.indices(1)])


@contextlib.contextmanager
def same_attempts(found, own, index, is_streamed):
    """An attempt at a step has the results of one device; the block gets the run on several, and its arguments."""
    alone = attempted(StageRun(found, own, index, plain()).arguments(1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "PhotoStore", functools.partial(PhotoStore, room=0 if is_streamed else None))
        run = StageRun(found, own, index, plain(), session=Session(devices=jax.devices()))
    yield run, (arguments := run.arguments(1))
    close(alone, attempted(arguments))
    run.photographs.close()


def lenses(folder):
    """Photographs behind two lenses, of which each device has the rays, have the gradients of one device."""
    found = behind_lenses(scene())
    camera = found.train[0].camera
    moved = np.abs(camera.rays - np.moveaxis(np.mgrid[:54, :72][::-1], 0, -1) - 0.5)
    assert np.nanmax(moved) > 5, "the lens bends by many pixels"
    exchange = exchange_among(jax.devices())

    def loss(model, output):
        consistency = normal_consistency(output.normal, output.depth, output.alpha, camera)
        return jnp.mean(output.color**2) + consistency + jnp.mean(output.distortion)

    same_gradients(loss, textured(), camera, exchange, "native")
    own = system(a2tg.A2tg, densify={"cap": 0}, exposure=True, batch_size=4)
    with same_attempts(found, own, 0, False) as (_, arguments):
        rays = arguments[4].rays
        assert len(rays.sharding.device_set) == 4 and rays.is_fully_replicated
        assert arguments[0].render.exchange.views_at_once == 4


def attempted(arguments):
    tried = jax.jit(spread_attempt, static_argnums=(0,))(*arguments)
    return tried.views._replace(num_pairs=0, grads=tried.grads), tried.state.model


def check_parts(images, expected):
    """Two devices hold the halves of the first three photographs, two others those of the last three."""
    parts = [np.asarray(part.data) for part in images.addressable_shards]
    assert [part.shape for part in parts] == [(3, 27, 72, 3)] * 4
    halves = [np.concatenate(parts[:2], axis=1), np.concatenate(parts[2:], axis=1)]
    np.testing.assert_array_equal(np.concatenate(halves), expected)


def training(folder):
    """The same devices give the same bits when resumed; other numbers of them end with the same quality."""
    own = system(Gaussians2dMcmc, stage1_iterations=24, densify={"cap": 152})
    path, path_alone = (Path(folder) / name for name in ("together.npz", "alone.npz"))

    def keeping(path):
        return lambda found: found.iteration == 12 and a2tg.save_checkpoint(path, found)

    whole = fit(own, 4, on_checkpoint=keeping(path), checkpoint_every=12)
    assert path.is_file() and len(whole.model.gaussians.means.devices()) == 1, "results are on one device"
    alone = fit(own, 1, on_checkpoint=keeping(path_alone), checkpoint_every=12)
    end = psnr_of(alone)
    for count, start in ((4, path), (3, path_alone)):
        with warnings.catch_warnings(record=True) as printed:
            warnings.simplefilter("always")
            again = fit(own, count, resume=a2tg.load_checkpoint(start))
        assert any("152 rows, which 3 devices cannot share" in str(one.message) for one in printed) == (count == 3)
        assert again.model.num == alone.model.num and abs(psnr_of(again) - end) < 0.02, count
        if count == 4:
            np.testing.assert_array_equal(whole.model.gaussians.means, again.model.gaussians.means)


def textures(folder):
    """Textures grow as on one device; rows that do not divide evenly are filled up."""
    own = system(a2tg.A2tg, densify={"cap": 118}, texture={"at": (0.5,)}, stage2_iterations=8)
    sessions = Session(), Session(devices=jax.devices())
    alone, together = (fit_stage(scene(), own, 1, plain(), progress=False, session=each) for each in sessions)
    assert alone.model.num == together.model.num
    single = ROWS * bytes_per_gaussian(1, 4)
    assert alone.model.num_bytes == together.model.num_bytes > single, "textures have grown"
    assert abs(psnr_of(alone) - psnr_of(together)) < 0.02
    assert padded(plain(), own.stages()[0], own, 4).gaussians.num == 120


def pruned_and_detailed():
    """A system whose stages prune, place Gaussians, raise degrees and let textures grow."""
    return system(
        a2tg.Bytewise, densify={"cap": 120}, stage1_iterations=20, stage2_iterations=20,
        prune={"share": 0.3, "at": (0.2,)}, place={"at": (0.2,)}, floaters={"min_views": 3, "at": (0.4,)},
        view_dependence_share=0.2, view_dependence={"at": (0.2,)}, texture_share=0.2, details={"at": (0.4,)},
    )  # fmt: skip


def events(folder):
    """Events on the host."""
    rows_are_read_and_moved(exchange_among(jax.devices()))
    custom_events_change_rows(Session(devices=jax.devices()))
    events_change_the_same(Session(devices=jax.devices()))


def events_change_the_same(session):
    """Events of spread arrays lead to the bits of one device, and none of them puts all rows on one."""
    own, happened = pruned_and_detailed(), []
    for index in (0, 1):
        alone, together = (
            StageRun(scene(), own, index, initial_model(scene(), own), session=each) for each in (None, session)
        )
        done = 0
        for due in sorted(set(together._due_on_host())):
            while done < due:
                done += len(together.steps(done + 1, due))
            alone.state = jax.tree.map(jnp.array, readable(together.state))
            with no_whole_rows(together.state.model.gaussians.num):
                together._host_events(due)
            alone._host_events(due)
            same_bits(alone.state, readable(together.state))
            same_bits(alone.model, together.model)
            assert_spread(together.state)
            events = [e for e in together.stage.events if isinstance(e, HostEvent) and due in e.iterations(20)]
            happened += [(type(each).__name__, together.model.num, together.model.num_bytes) for each in events]
        alone.photographs.close()
        together.photographs.close()
    names = ["Prune", "PlaceByError", "PruneFloaters", "Prune", "AdaptDegrees", "Upscale"]
    assert [name for name, *_ in happened] == names, happened
    assert len({(num, num_bytes) for _, num, num_bytes in happened}) > 3, happened


@contextlib.contextmanager
def no_whole_rows(num):
    """Fail if functions of `parallel.sharded_rows` leave new arrays of `num` rows or more on one device, or on each."""
    known, found = jax.live_arrays(), set()
    ids = set(map(id, known))

    def look(frame, what, result):
        if what == "return" and frame.f_code.co_filename == rows.__file__:
            new = [x for x in jax.live_arrays() if id(x) not in ids and x.size and x.ndim and len(x) >= num]
            found.update(x.shape for x in new if x.is_fully_replicated)

    sys.setprofile(look)
    try:
        yield
    finally:
        sys.setprofile(None)
    assert not found, found


def assert_spread(state):
    """All arrays of rows that the devices can share are shared."""
    for leaf in jax.tree.leaves(state):
        is_shared = leaf.ndim > 0 and leaf.shape[0] >= jax.device_count() and leaf.shape[0] % jax.device_count() == 0
        assert len(leaf.sharding.device_set) == jax.device_count()
        assert not leaf.size or leaf.is_fully_replicated != is_shared, (leaf.shape, leaf.sharding)


def same_bits(expected, found):
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert a.dtype == b.dtype and a.shape == b.shape
        np.testing.assert_array_equal(a.reshape(-1).view(np.uint8), b.reshape(-1).view(np.uint8))


@a2tg.pytree
class Reverse(HostEvent):
    """A custom event that reverses the order of the rows."""

    def iterations(self, num_iterations):
        return (2,)

    def apply(self, due, model, moments, state):
        assert isinstance(due, Due) and on_host(model.gaussians.means).shape == (model.gaussians.num, 3)
        places = np.arange(model.gaussians.num)[::-1]
        by_jax = jax.tree.map(lambda x: x[places], model.gaussians)
        gaussians = dataclasses.replace(by_jax, means=on_host(model.gaussians.means)[places])
        return Change(dataclasses.replace(model, gaussians=gaussians), moments, state, rows=places)


@a2tg.pytree
class Remember(StepEvent):
    """A custom event whose state is made of values of the model and follows rows in its own way."""

    def init(self, model):
        return jnp.asarray(on_host(model.gaussians.means)[:, 0])

    def gather(self, state, rows):
        return jnp.asarray(on_host(state)[rows])

    def apply(self, now, model, moments, state):
        return Change(model, moments, state)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reversed(a2tg.System):
    name = "reversed"

    def stages(self):
        events = SplitByGradient(ROWS), Reverse(), Remember()
        return (a2tg.Stage("gaussians", a2tg.Appearance(), events, self.loss.terms(), self.rates, 4),)


def custom_events_change_rows(session):
    """Whatever events return is spread over the devices, however they make it."""
    own = Reversed(sh_degree=1, initial_gaussians=ROWS)
    run = StageRun(scene(), own, 0, plain(), session=session)
    run.steps(1, 2)
    known = run.state.model.gaussians.means, run.state.events[0].gradients.total, run.state.events[2]
    means, totals, remembered = map(on_host, known)
    assert len(np.unique(totals)) > 20 and len(np.unique(remembered)) > 20
    run._host_events(2)
    np.testing.assert_array_equal(on_host(run.state.model.gaussians.means), means[::-1])
    np.testing.assert_array_equal(on_host(run.state.events[0].gradients.total), totals[::-1])
    np.testing.assert_array_equal(on_host(run.state.events[2]), remembered[::-1])
    assert_spread(run.state)
    run._move_rows(np.arange(len(means))[::-1])  # As after an event that leaves arrays where they lie.
    np.testing.assert_array_equal(on_host(run.state.events[0].gradients.total), totals)
    np.testing.assert_array_equal(on_host(run.state.events[2]), remembered)
    run.photographs.close()


def rows_are_read_and_moved(exchange):
    """Arrays are read in parts, and rows may become fewer or more. Each device has all rows if they do not divide."""
    rng, num = np.random.default_rng(0), 2 * exchange.num
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rows, "LARGEST_PART", 48)
        for shape in ((3 * num, 4, 2), (3 * num,), (3 * num + 1, 2), (0, 2), ()):
            values = rng.normal(size=shape).astype(np.float32)
            x = spread(exchange.mesh, values)
            np.testing.assert_array_equal(on_host(x), values)
            assert x._npy_value is None or not (shape and shape[0] % num == 0 and shape[0])
            assert placed_like(values, x).sharding == x.sharding
            if shape and shape[0]:
                for places in rng.permutation(2 * num), rng.integers(0, len(values), 4 * num + 1):
                    moved = rows_moved(x, places)
                    np.testing.assert_array_equal(on_host(moved), values[places])
                    np.testing.assert_array_equal(rows_moved(jnp.asarray(values), places), values[places])
                    assert moved.sharding == sharding_of_rows(exchange.mesh, (len(places), *shape[1:]))
        values, last = rng.normal(size=(num, 2)), jax.local_devices()[-1]
        assert rows_moved(jax.device_put(values, last), np.arange(3)).devices() == {last}
        np.testing.assert_array_equal(rows_moved(values, np.arange(3)), values[:3], strict=True)
        columns = spread(exchange.mesh, values_of := rng.normal(size=(3, num)).astype(np.float32), axis=1)
        np.testing.assert_array_equal(on_host(columns), values_of)


def shared(folder):
    """What Gaussians share is whole on every device, though the devices divide its length, and learns as on one."""
    own, networks = Own(events="splitting", sh_degree=0, stage1_iterations=12), []

    def keep(checkpoint):
        networks.append(checkpoint.state.model.appearance.network)

    for count in (1, jax.device_count()):
        fit(own, count, on_checkpoint=keep)
    alone, together = networks
    for name, values in together.items():
        assert values.is_fully_replicated and len(values.sharding.device_set) == jax.device_count(), name
        np.testing.assert_allclose(on_host(values), alone[name], atol=1e-4)


def memory(folder):
    """The forecast of views that are drawn at once is what XLA says of a step."""
    found = a2tg.synthetic_scene(num_views=5, width=480, height=360, num_points=400)
    for size in (1, 4):
        own = system(Gaussians2dMcmc, densify={"cap": 400}, initial_gaussians=400, batch_size=size)
        run = StageRun(found, own, 0, initial_model(found, own), session=Session(devices=jax.devices()))
        arguments = run.arguments(1)
        lowered = jitted_step().lower(*arguments)
        said = jax.device_count() * lowered.compile().memory_analysis().temp_size_in_bytes
        expected = stage_bytes(found, own, run.stage, 400, run.model.num_bytes, jax.device_count())
        assert 0.75 < (expected.gradients + expected.pixels) / said < 1.33, (size, expected, said)
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
