"""Lists, masked arrays and foreign byte order are converted where that loses nothing, else named."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_camera, as_gaussians, as_textures, draw_scene

import a2tg_jax as a2tg


class Tensor:
    """An array of another library."""

    def __init__(self, values):
        self.values, self.shape, self.dtype = values, values.shape, str(values.dtype)

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.values, dtype)


SCENE = draw_scene(1, num=20)
GAUSSIANS, CAMERA = (jax.tree.map(np.asarray, make(SCENE, "float32")) for make in (as_gaussians, as_camera))
TEXTURES = jax.tree.map(np.asarray, as_textures(SCENE, "float32"))
IMAGE = np.random.default_rng(0).uniform(size=(30, 43, 3)).astype(np.float32)
KINDS = {
    "list": lambda x: x.tolist(),
    "masked": np.ma.masked_array,
    "big-endian": lambda x: x.astype(x.dtype.newbyteorder(">")),
    "Fortran": np.asfortranarray,
    "read-only": lambda x: np.broadcast_to(x, x.shape),
    "other library": lambda x: Tensor(x),
}
every_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


def image(gaussians=GAUSSIANS, camera=CAMERA, textures=TEXTURES, **options):
    return np.asarray(a2tg.render_image(gaussians, camera, textures, **options).color)


@pytest.fixture(scope="module")
def wanted():
    return image()


@every_kind
@pytest.mark.parametrize("field", [None, *(field.name for field in dataclasses.fields(a2tg.Gaussians))])
def test_gaussians(kind, field, wanted):
    fields = {f.name: getattr(GAUSSIANS, f.name) for f in dataclasses.fields(GAUSSIANS)}
    changed = {name: kind(x) if field in (None, name) else x for name, x in fields.items()}
    np.testing.assert_array_equal(image(a2tg.Gaussians(**changed)), wanted)


@every_kind
def test_cameras_and_textures(kind, wanted):
    camera = a2tg.Camera(kind(CAMERA.viewmat), kind(CAMERA.K), CAMERA.width, CAMERA.height)
    buckets = [kind(bucket) for bucket in TEXTURES.buckets]
    textures = a2tg.Textures(buckets, kind(TEXTURES.bucket), kind(TEXTURES.row), TEXTURES.bucket_sizes)
    np.testing.assert_array_equal(image(camera=camera, textures=textures), wanted)


@every_kind
def test_images_features_backgrounds_and_points(kind):
    for score in (a2tg.photometric_loss, a2tg.psnr, a2tg.ssim):
        np.testing.assert_array_equal(score(kind(IMAGE), kind(IMAGE[::-1])), score(IMAGE, IMAGE[::-1]))
    features = IMAGE[0, :20, :2]
    background = np.asarray([0.25, 0.5], np.float32)
    given = image(features=kind(features), background=kind(background))
    np.testing.assert_array_equal(given, image(features=features, background=background))
    points = IMAGE[0]
    colors = IMAGE[1]
    own, other = (a2tg.init_from_points(*pair) for pair in ((kind(points), kind(colors)), (points, colors)))
    assert all(map(np.array_equal, jax.tree.leaves(own), jax.tree.leaves(other)))


def masked(x):
    return np.ma.masked_array(x, np.arange(x.size).reshape(x.shape) == 1)


@pytest.mark.parametrize(
    ("message", "call"),
    [
        ("gaussians.sh has masked entries: ", lambda: dataclasses.replace(GAUSSIANS, sh=masked(GAUSSIANS.sh))),
        ("camera.K has masked entries: ", lambda: dataclasses.replace(CAMERA, K=masked(CAMERA.K))),
        ("textures.row has masked entries: ", lambda: dataclasses.replace(TEXTURES, row=masked(TEXTURES.row))),
        ("textures.buckets[1] has masked", lambda: dataclasses.replace(
            TEXTURES, buckets=(TEXTURES.buckets[0], masked(TEXTURES.buckets[1])))),
        ("image has masked entries: ", lambda: a2tg.photometric_loss(masked(IMAGE), IMAGE)),
        ("target has masked entries: ", lambda: a2tg.psnr(IMAGE, masked(IMAGE))),
        ("points has masked entries: ", lambda: a2tg.init_from_points(masked(IMAGE[0]), IMAGE[0])),
        ("mask has masked entries: ", lambda: a2tg.psnr(IMAGE, IMAGE, masked(IMAGE[..., 0] > 0.5))),
        ("background has masked entries: ", lambda: image(background=masked(IMAGE[0, 0]))),
        ("texture 0 has masked entries: ", lambda: a2tg.textures_from_arrays([masked(IMAGE[:2, :4])])),
        ("rows has masked entries: ", lambda: a2tg.Model(GAUSSIANS)[masked(np.arange(3))]),
        ("points has masked entries: ", lambda: a2tg.scene_from_arrays(
            [np.zeros((30, 40, 3), np.uint8)] * 3, np.tile(np.eye(4), (3, 1, 1)), np.eye(3), masked(IMAGE[0]))),
        ("gaussians.means must be an array; got a list whose rows", lambda: a2tg.Gaussians([[0, 0], [1]], *[0] * 4)),
        ("gaussians.quats must be an array; got tuple: use jnp.asarray", lambda: image(
            dataclasses.replace(GAUSSIANS, quats=tuple(map(tuple, GAUSSIANS.quats))))),
        ("gaussians.means must be floats; got object", lambda: image(
            dataclasses.replace(GAUSSIANS, means=GAUSSIANS.means.astype(object)))),
        ("gaussians.sh must be an array; got str", lambda: image(dataclasses.replace(GAUSSIANS, sh="red"))),
    ],
)  # fmt: skip
def test_what_would_lose_something_is_named(message, call):
    with pytest.raises(ValueError) as error:
        call()
    assert message in str(error.value)


def test_pytrees_may_hold_anything_else():
    """What JAX and its users put instead of arrays is not changed."""
    spec = jax.sharding.PartitionSpec("rows")
    for leaf in (None, 0, 1.5, "name", (5, 3), spec, [spec], jax.ShapeDtypeStruct((2,), jnp.float32), object()):
        filled = jax.tree.map(lambda _, leaf=leaf: leaf, (GAUSSIANS, CAMERA, TEXTURES))
        assert filled[0].means is leaf and filled[1].K is leaf and filled[2].buckets[0] is leaf
        assert filled[2].row is leaf
    shapes = jax.tree.map(jnp.shape, GAUSSIANS)
    assert shapes.means == (20, 3)
    traced = jax.jit(lambda x: dataclasses.replace(GAUSSIANS, means=[[x, x]]).means[0][0])(2.0)
    assert traced == 2.0
