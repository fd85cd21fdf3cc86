"""Panoramas are cut into perspective views that agree with direct renders of the built-in scene."""

from contextlib import nullcontext
from pathlib import PurePosixPath

import numpy as np
import pytest
from PIL import Image, PngImagePlugin
from scipy.ndimage import map_coordinates
from test_data_sfm import cameras_of, staged

from a2tg_jax import load_scene, look_at, with_validation_views
from a2tg_jax.data import synthetic
from a2tg_jax.data.colmap_library import pycolmap
from a2tg_jax.data.decoding import picture_facts
from a2tg_jax.data.panoramas import projection_of
from a2tg_jax.data.staging import cut_view, directions, view_size

CENTER = np.array([0.3, -1.2, 1.2])
TARGET = (0, 0.1, 0.45)
WIDTH, FACE = 640, 224


def camera(rotation):
    """World to camera of a view with a rotation from the panorama's frame."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation @ look_at(CENTER, TARGET, width=1, height=1).viewmat[:3, :3]
    viewmat[:3, 3] = -viewmat[:3, :3] @ CENTER
    return viewmat


def render(surfaces, rotation, focal, side):
    K = np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    with np.errstate(invalid="ignore"):
        return synthetic.render(surfaces, camera(rotation), K, side, side)


@pytest.fixture(scope="module")
def surfaces():
    rng = np.random.default_rng(0)
    return synthetic.light(synthetic.still_life(rng), rng)


@pytest.fixture(scope="module")
def panorama(surfaces):
    """Six renders of a cube, resampled: longitude grows to the right, from -π; latitude falls from π/2."""
    longitude, latitude = np.meshgrid(
        (np.arange(WIDTH) + 0.5) / WIDTH * 2 * np.pi - np.pi,
        np.pi / 2 - (np.arange(WIDTH // 2) + 0.5) / WIDTH * 2 * np.pi,
    )
    rays = np.stack([np.cos(latitude) * np.sin(longitude), -np.sin(latitude), np.cos(latitude) * np.cos(longitude)], -1)
    seen = np.zeros((*rays.shape[:2], 3))
    axis = np.abs(rays).argmax(-1)
    focal = FACE / 2
    for number in range(3):
        for sign in (1, -1):
            z = sign * np.eye(3)[number]
            x = np.eye(3)[number - 1]
            rotation = np.stack([x, np.cross(z, x), z])
            face = render(surfaces, rotation, focal, FACE)
            is_on = (axis == number) & (np.sign(rays[..., number]) == sign)
            at = rays[is_on] @ rotation.T
            places = (at[:, 1::-1] / at[:, 2:] * focal + FACE / 2 - 0.5).T
            seen[is_on] = np.stack(
                [map_coordinates(face[..., c] * 1.0, places, order=1, mode="nearest") for c in range(3)], -1
            )
    return np.rint(seen).astype(np.uint8)


@pytest.mark.parametrize("name", ["heading000", "heading120", "heading240", "up", "down"])
def test_views_agree_with_direct_renders(surfaces, panorama, name):
    (direction,) = [direction for direction in directions() if direction.name == name]
    side, focal = view_size(WIDTH)
    direct = render(surfaces, direction.rotation, focal, side)
    cut = cut_view(panorama, direction).astype(float)
    error = np.abs(cut - direct)
    assert np.median(error) <= 2 and error.mean() < 6
    assert np.abs(np.roll(cut, 3, 1) - direct).mean() > 1.5 * error.mean()


def test_views_show_every_direction():
    rays = np.random.default_rng(0).normal(size=(20_000, 3))
    tangent = np.tan(np.deg2rad(50))
    is_seen = np.zeros(len(rays), bool)
    for direction in directions():
        x, y, z = direction.rotation @ rays.T
        is_seen |= (z > 0) & (np.abs(x) <= tangent * z) & (np.abs(y) <= tangent * z)
    assert is_seen.all()


SIDE = WIDTH // 2
ROWS, COLUMNS = np.mgrid[0:SIDE, 0:WIDTH]
ABOVE = (ROWS < 0.42 * SIDE)[..., None]
BELOW = (ROWS > 0.6 * SIDE)[..., None]
FROM_MIDDLE = np.hypot(2 * COLUMNS / WIDTH - 1, 2 * ROWS / SIDE - 1)[..., None]
"""Distance from the middle of a picture, in half sides."""
ROUND = np.hypot(*(np.mgrid[0:SIDE, 0:SIDE] - SIDE / 2 + 0.5))[..., None] / SIDE
"""Distance from the middle of half a picture, in its side."""


def noisy(pixels, sigma=1.0):
    pixels = pixels + np.random.default_rng(0).normal(0, sigma, pixels.shape)
    return np.rint(np.clip(pixels, 0, 255)).astype(np.uint8)


WHOLE = {
    "as it is": lambda own: own,
    "turned": lambda own: np.roll(own, 100, axis=1),
    "small": lambda own: own[::4, ::4],
    "large": lambda own: np.asarray(Image.fromarray(own).resize((2 * WIDTH, WIDTH))),
    "plain sky": lambda own: np.where(ABOVE, [140, 180, 230], own),
    "plain sky and floor": lambda own: np.where(ABOVE, [140, 180, 230], np.where(BELOW, 90, own)),
    "sky with a gradient": lambda own: np.where(ABOVE, [140, 180, 230] - ROWS[..., None] / 4, own),
    "black nadir": lambda own: np.where(ROWS[..., None] > 0.85 * SIDE, 0, own),
    "noise": lambda own: noisy(own, 5.0),
    "dark": lambda own: own / 3,
    "with alpha": lambda own: np.dstack([own, np.full((SIDE, WIDTH), 255)]),
}  # fmt: skip


@pytest.mark.parametrize("name", WHOLE)
def test_panoramas_are_recognised(panorama, name):
    assert projection_of(np.rint(WHOLE[name](panorama)).astype(np.uint8)) == "panorama"


def flat(own, left=100, top=80):
    """A part of a panorama, as a photograph of its width shows it."""
    return np.asarray(Image.fromarray(own[top : top + 160, left : left + 320]).resize((WIDTH, SIDE)))


def product(own, behind):
    return noisy(np.where(FROM_MIDDLE < 0.6, flat(own), behind))


def fisheyes(own, radius=0.49, black=4):
    halves = [np.where(radius > ROUND, flat(own, left, 155)[:, :SIDE], black) for left in (0, 150)]
    return noisy(np.concatenate(halves, axis=1))


def diptych(left, right):
    return np.concatenate([left[:, :SIDE], right[:, :SIDE]], axis=1)


OTHERS = {
    "not twice as wide": (None, lambda own: own[:, 1:]),
    "a photograph": ("photograph", flat),
    "a landscape": (None, lambda own: np.where(ABOVE, [140, 180, 230], flat(own))),
    "a product on white": ("unclear", lambda own: product(own, 245)),
    "on black": ("unclear", lambda own: product(own, 8)),
    "on a gradient": ("unclear", lambda own: product(own, 150 + ROWS[..., None] / 4)),
    "on a table": ("unclear", lambda own: product(own, np.where(BELOW, 120, 220))),
    "in a vignette": (None, lambda own: product(own, 240) * np.clip(1 - FROM_MIDDLE**2 / 2.2, 0, 1)),
    "a dark vignette": (None, lambda own: flat(own) * np.clip(1.1 - FROM_MIDDLE**2, 0, 1)),
    "a frame": (None, lambda own: np.pad(flat(own)[9:-9, 9:-9], ((9, 9), (9, 9), (0, 0)), constant_values=30)),
    "wide bars": (None, lambda own: np.where(np.abs(ROWS - SIDE / 2)[..., None] > SIDE / 3, 0, flat(own))),
    "a diptych": ("photograph", lambda own: diptych(flat(own), flat(own, 300))),
    "a stereo pair": ("photograph", lambda own: diptych(flat(own), flat(own, 110))),
    "in a mirror": (None, lambda own: np.concatenate([flat(own)[:, :SIDE], flat(own)[:, :SIDE][:, ::-1]], axis=1)),
    "a cylinder": ("photograph", lambda own: np.asarray(Image.fromarray(own[80:240]).resize((WIDTH, SIDE)))),
    "noise": (None, lambda own: noisy(np.full(own.shape, 128), 60)),
    "fisheyes": ("fisheyes", fisheyes),
    "small fisheyes": ("fisheyes", lambda own: fisheyes(own, 0.45, 0)),
    "cut fisheyes": ("fisheyes", lambda own: fisheyes(own, 0.52, 16)),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHERS)
def test_other_pictures_are_not_taken_for_panoramas(panorama, name):
    kind, change = OTHERS[name]
    pixels = np.rint(change(panorama)).astype(np.uint8)
    assert projection_of(pixels) != "panorama"
    assert kind is None or projection_of(pixels) == kind


XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {}</rdf:Description></rdf:RDF></x:xmpmeta>"""
ATTRIBUTE = 'GPano:ProjectionType="equirectangular">'
ELEMENTS = "><GPano:ProjectionType>equirectangular</GPano:ProjectionType>"
CROPPED = (
    "<GPano:FullPanoWidthPixels>9000</GPano:FullPanoWidthPixels>"
    "<GPano:CroppedAreaImageWidthPixels>640</GPano:CroppedAreaImageWidthPixels>"
)


@pytest.mark.parametrize(
    ("text", "is_whole"),
    [
        (ATTRIBUTE, True),
        (ELEMENTS, True),
        (ELEMENTS + CROPPED, False),
        ('GPano:ProjectionType="cylindrical">', False),
        (">", None),
    ],
)
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_metadata_decide(tmp_path, text, is_whole, suffix):
    """A white picture that says so is a panorama."""
    xmp = XMP.format(text).encode()
    info = PngImagePlugin.PngInfo()
    info.add_itxt("XML:com.adobe.xmp", xmp.decode())
    for index in range(3):
        white = Image.new("RGB", (64, 32), (255 - 40 * index,) * 3)
        white.save(tmp_path / f"{index}{suffix}", **({"pnginfo": info} if suffix == ".png" else {"xmp": xmp}))
    assert picture_facts(tmp_path / f"0{suffix}").is_panorama == is_whole
    with nullcontext() if is_whole is not None else pytest.warns(UserWarning, match="3 pictures twice as wide as high"):
        found = staged([tmp_path], tmp_path / "work")
    assert len(found.rigs) == bool(is_whole)


def test_unclear_pictures_are_what_most_of_their_source_and_size_are(tmp_path, panorama):
    small = panorama[::4, ::4]
    turned = np.roll(small, 9, axis=1)
    pictures = {"a/0": small, "a/1": turned, "a/2": np.full_like(small, 255), "b/0": small[::2, ::2]}
    pictures |= {"b/1": np.full_like(pictures["b/0"], 255), "b/2": np.full_like(pictures["b/0"], 254)}
    for name, pixels in pictures.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
    found = staged([tmp_path / "a", tmp_path / "b"], tmp_path / "work")
    assert sorted(len(rig.groups[0].names) for rig in found.rigs) == [3, 3] and not found.groups
    Image.fromarray(np.full((80, 160, 3), 250, np.uint8)).save(tmp_path / "b" / "3.png")
    with pytest.warns(UserWarning, match=r"1 picture twice as wide as high, such as b/3.png: .* `panorama` yes cuts"):
        found = staged([tmp_path / "a", tmp_path / "b"], tmp_path / "other")
    assert [group.names for group in found.groups] == [("b/3.png",)]


def test_fisheyes_are_refused(tmp_path, panorama):
    for index in range(3):
        Image.fromarray(fisheyes(panorama)).save(tmp_path / f"{index}.png", compress_level=index)
    with pytest.raises(ValueError, match=r"0\.png: shows two fisheyes side by side.*: stitch them first"):
        staged([tmp_path], tmp_path / "work")
    assert not staged([tmp_path], tmp_path / "other", "no").rigs


@pytest.mark.parametrize("choice", ["auto", "no"])
def test_panoramas_become_a_rig(tmp_path, panorama, choice):
    """The views of one panorama share a place: a frame of the rig, with cameras that are known."""
    for index in range(3):
        Image.fromarray(panorama[::4, ::4]).save(tmp_path / f"{index}.png", compress_level=index)
    printed = []
    found = staged([tmp_path], tmp_path / "work", choice, printed.append)
    cameras, frames = cameras_of(found, tmp_path)
    if choice == "no":
        assert (len(cameras), len(frames), printed) == (1, 3, [])
        return
    assert printed == ["3 panoramas of 160x80, each cut into 8 views of 60x60; panorama='no' leaves them whole"]
    assert (len(cameras), len(frames), found.num_places, len(found.names)) == (8, 3, 3, 24)
    assert all(len(frame.data_ids) == 8 for frame in frames)
    assert all(camera.model.name == "PINHOLE" and camera.has_prior_focal_length for camera in cameras)


def test_views_of_panoramas_have_names_of_their_own(tmp_path, panorama):
    (tmp_path / "panorama").mkdir()
    for name in ("0.png", "0.png.jpg", "panorama/flat.png"):
        pixels = panorama[::16, ::16] if name[0] == "0" else panorama[:10, :15]
        Image.fromarray(pixels).save(tmp_path / name)
    found = staged([tmp_path], tmp_path / "work", "yes")
    assert len(set(found.names)) == 17 and found.rigs[0].folder == "panorama~2"
    assert all((found.folder / name).is_file() for name in found.names)


@pytest.fixture(params=["panoramas", "refined", "stereo"])
def rig_scene(request, tmp_path):
    """Three views at each of five places, of one point (refined: nearly) or apart, named 0/0.png, 0/1.png, ..."""
    apart = {"panoramas": 0.0, "refined": 1e-5, "stereo": 0.1}[request.param]
    options = pycolmap().SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=3, num_frames_per_rig=5, num_points3D=9, camera_width=16, camera_height=12,
        camera_model_id=pycolmap().CameraModelId.PINHOLE, camera_params=[16.0, 16.0, 8.0, 6.0],
        sensor_from_rig_translation_stddev=apart,
    )  # fmt: skip
    model = pycolmap().synthesize_dataset(options)
    for image in model.images.values():
        image.name = f"{image.camera_id}/{image.frame_id}.png"
        (tmp_path / "images" / image.name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (16, 12)).save(tmp_path / "images" / image.name)
    (tmp_path / "sparse").mkdir()
    model.write(tmp_path / "sparse")
    return request.param, tmp_path


def test_the_views_of_a_panorama_are_held_out_together(rig_scene):
    kind, folder = rig_scene
    scene = load_scene(folder, test_every=2)
    sizes = []
    common = []
    for made in (scene, with_validation_views(scene)):
        train, test = ([PurePosixPath(view.name).stem for view in views] for views in (made.train, made.test))
        sizes.append((len(train), len(test)))
        common.append(bool({*train} & {*test}))
    assert sizes == ([(6, 9), (3, 3)] if kind != "stereo" else [(7, 8), (6, 1)])
    assert common == [kind == "stereo"] * 2
    if kind != "stereo":
        one = load_scene(folder, test_every=4)
        assert {view.name for view in one.test} == {f"{camera}/{place}.png" for camera in (1, 2, 3) for place in (1, 5)}
        with pytest.raises(ValueError, match="there is 1 panorama, cut into 3 views"):
            with_validation_views(with_validation_views(scene))
