"""A model and a checkpoint of every system, of a dozen Gaussians, made without training; random weights of LPIPS."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import a2tg_jax as a2tg
from a2tg_jax import Bands, Checkpoint, History, Model, Now, Origin, allocate_appearance, init_from_points
from a2tg_jax.appearance.parts import bands_of_dense
from a2tg_jax.training.start import initial_state

NUM = 12


def some_gaussians():
    rng = np.random.default_rng(0)
    return init_from_points(rng.normal(size=(NUM, 3)), rng.uniform(size=(NUM, 3)), sh_degree=0)


def some_origin():
    cameras = [a2tg.Camera(jnp.eye(4), jnp.diag(jnp.asarray([40.0, 40.0, 1.0])), 32, 24) for _ in range(2)]
    return Origin.of_cameras(cameras, ["a.png", "b.png"])


def some_model(system=None):
    """Of the last stage of a system."""
    stage = (system or a2tg.A2tg(sh_degree=0)).stages()[-1]
    gaussians = some_gaussians()
    appearance = allocate_appearance(stage.appearance, jax.random.key(0), gaussians)
    return Model(gaussians, appearance, origin=some_origin())


def with_bands(model, dense, degrees):
    """The model with spherical harmonics [N, K, 3] above its own degree, up to a degree for each Gaussian."""
    bands = Bands(bands_of_dense(np.asarray(dense), np.asarray(degrees), model.gaussians.sh_degree))
    return dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, bands=bands))


def movable_kernels(**changes):
    """The appearance of SuperGaussians."""
    return dataclasses.replace(a2tg.SuperGaussians().stages()[0].appearance, **changes)


def billboards(**changes):
    """The appearance of BBSplat."""
    return dataclasses.replace(a2tg.BBSplat().stages()[0].appearance, **changes)


def rule_of(appearance):
    """The appearance without its arrays: its class, parts and options."""
    return appearance.template


def assert_same_rule(found, wanted):
    assert rule_of(found.appearance) == rule_of(wanted.appearance)


def numbers_of(model):
    """All numbers of a model by name, of any padding."""
    numbers = {field.name: getattr(model.gaussians, field.name) for field in dataclasses.fields(model.gaussians)}
    numbers |= {"sh": model.sh, "degrees": model.degrees}
    if model.textures is not None:
        numbers |= {"sizes": model.textures.sizes, "texels": model.textures.flat()}
    if model.appearance.shapes is not None:
        numbers["shapes"] = model.appearance.shapes
    return {name: np.asarray(values) for name, values in numbers.items()}


def origin_of(scene):
    """The origin of a model that was trained on a scene."""
    views = [*scene.train, *scene.test]
    is_test = [False] * len(scene.train) + [True] * len(scene.test)
    names = [view.name for view in views]
    return Origin.of_cameras([view.camera for view in views], names, is_test=is_test, transform=scene.transform)


def with_row(history: History, *values: float, **terms: float) -> History:
    """The history with a further row: values in the order of the fields, and loss terms by name."""
    columns = (np.asarray([value]) for value in values)
    return history.followed_by(History(*columns, {name: np.asarray([value]) for name, value in terms.items()}))


def some_checkpoint(system):
    model = some_model(system)
    live = Model(model.gaussians, model.appearance, jnp.int32(NUM - 2))
    stages = system.stages()
    history = with_row(History.empty(), len(stages), 1, 0.5, 20.0, NUM, 0.1, 2.0)
    return Checkpoint(system, len(stages) - 1, initial_state(stages[-1], live), history)


def some_now(iteration, num_iterations, num_left=None, *, num_keys=1, scene_scale=1.0):
    """What an event inside the step is given."""
    numbers = (jnp.asarray(number, jnp.int32) for number in (iteration, num_iterations))
    keys = jax.random.split(jax.random.key(0), num_keys)
    done, length = numbers
    return Now(keys, done, jnp.float32(1e-4), length, jnp.float32(scene_scale), num_left)


def write_random_squeeze(path):
    """A weights file of SqueezeNet's layout with random numbers in it."""
    rng = np.random.default_rng(0)
    arrays = {}

    def add(name, out, inputs, size):
        arrays[f"{name}.weight"] = rng.normal(0, (2 / (inputs * size**2)) ** 0.5, (out, inputs, size, size))
        arrays[f"{name}.bias"] = np.zeros(out)

    add("features.0", 64, 3, 3)
    inputs = 64
    widths = {3: 16, 4: 16, 6: 32, 7: 32, 9: 48, 10: 48, 11: 64, 12: 64}
    for index, squeezed in widths.items():
        expanded = 4 * squeezed
        add(f"features.{index}.squeeze", squeezed, inputs, 1)
        add(f"features.{index}.expand1x1", expanded, squeezed, 1)
        add(f"features.{index}.expand3x3", expanded, squeezed, 3)
        inputs = 2 * expanded
    for index, channels in enumerate([64, 128, 256, 384, 384, 512, 512]):
        arrays[f"lin{index}.weight"] = rng.uniform(0, 1, (1, channels, 1, 1))
    np.savez(path, **{name: array.astype(np.float32) for name, array in arrays.items()})
    return path
