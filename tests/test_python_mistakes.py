"""Mistakes of a caller of the library: each is an error or a warning that says what was wanted."""

import dataclasses
import re
import signal
import tempfile
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_models import some_model
from small_values import some_gaussians, some_world
from test_data_colmap import write_scene as write_colmap

import a2tg_jax as a2tg
from a2tg_jax.appearance import Bands, Exponents
from a2tg_jax.host import signals
from a2tg_jax.training import Checkpoint, History
from a2tg_jax.training.checkpoint import check_resume
from a2tg_jax.training.options import Corrections

CAMERA = a2tg.Camera(jnp.eye(4).at[2, 3].set(3), jnp.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]), 16, 12)


def crowd() -> a2tg.Model:
    """Return Gaussians that lie in more tiles than a capacity of 1 has room for."""
    return a2tg.Model(some_gaussians(40))


def with_pose(matrix) -> a2tg.Camera:
    return dataclasses.replace(CAMERA, viewmat=jnp.asarray(matrix, jnp.float32))


def test_an_eager_render_with_too_small_a_capacity_warns_and_a_jitted_one_cannot():
    model, settings = crowd(), a2tg.RenderSettings(capacity=1)
    with pytest.warns(a2tg.CapacityWarning, match=re.escape("plan_render(model, cameras)")) as caught:
        assert model.render(CAMERA, settings=settings).overflow
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert jax.jit(lambda camera: model.render(camera, settings=settings))(CAMERA).overflow
        assert not model.render(CAMERA, settings=a2tg.plan_render(model, [CAMERA])).overflow


@pytest.mark.parametrize("capacity", [0, -3, 1e4, True, "4"])
def test_a_capacity_is_a_positive_int(capacity):
    with pytest.raises(ValueError, match="capacity must be an int, at least 1, or None"):
        a2tg.RenderSettings(capacity=capacity)


def test_plan_render_takes_a_model_as_evaluate_and_save_ply_do():
    model = some_model()
    planned = a2tg.plan_render(model.gaussians, [CAMERA], appearance=model.appearance)
    assert a2tg.plan_render(model, [CAMERA]) == planned
    with pytest.raises(ValueError, match=re.escape("say plan_render(model, cameras)")):
        a2tg.plan_render(model, [CAMERA], appearance=model.appearance)


def test_a_moved_model_renders_the_same_with_settings_that_are_scaled_along():
    near = a2tg.Camera(jnp.eye(4).at[2, 3].set(0.7), CAMERA.K, 16, 12)
    origin = a2tg.Origin.of_cameras([near])
    model, world = dataclasses.replace(a2tg.Model(some_gaussians(40)), origin=origin), some_world()
    world = dataclasses.replace(world, scale=0.2)
    moved = model.transform(world)
    assert moved.origin is not None
    settings = a2tg.RenderSettings()
    shown = model.render(near, settings=settings).color
    again = moved.render(moved.origin.cameras[0], settings=settings.transform(world)).color
    np.testing.assert_allclose(again, shown, atol=2e-5)
    assert np.abs(moved.render(moved.origin.cameras[0], settings=settings).color - shown).max() > 0.01


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([1.0, -1, 1, 1]), "mirrors"),
        (np.diag([2.0, 2, 2, 1]), "R·Rᵀ − I up to 3"),
        (np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 3, 1]]), "its last row must be 0, 0, 0, 1"),
    ],
)
def test_a_pose_that_is_no_rigid_motion_is_refused_outside_jit(matrix, message):
    with pytest.raises(ValueError, match=f"camera.viewmat must be a rigid motion, world to camera, OpenCV.*{message}"):
        crowd().render(with_pose(matrix))
    settings = a2tg.RenderSettings(capacity=1024)
    jax.jit(lambda camera: crowd().render(camera, settings=settings))(with_pose(matrix))


def test_a_pose_that_drifted_a_little_is_rendered():
    crowd().render(with_pose(np.diag([1.01, 0.995, 1, 1])))


def test_a_camera_says_its_convention_and_prints_numbers():
    assert "OpenCV" in a2tg.Camera.__doc__ and "+0.5" in a2tg.Camera.__doc__
    camera = dataclasses.replace(CAMERA, width=np.int64(80))
    assert "width=80" in repr(camera) and type(camera.width) is int


@pytest.mark.parametrize(
    ("colors", "message"),
    [
        (np.full((9, 3), 200, np.uint8), "colors must be floats in [0, 1]; got uint8: divide bytes by 255"),
        (np.full((9, 3), 200.0), "colors must lie in [0, 1]; got 200: divide bytes by 255"),
        (np.full((9, 3), -0.5), "colors must lie in [0, 1]; got -0.5"),
    ],
)
def test_colours_of_points_lie_in_the_unit_range(colors, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        a2tg.init_from_points(np.random.default_rng(0).normal(size=(9, 3)), colors)


def test_the_public_names_hold_no_helpers():
    names = dir(a2tg)
    assert not {"Any", "TYPE_CHECKING", "importlib"} & set(names)
    assert "__version__" in names and re.match(r"\d+\.\d+", a2tg.__version__)
    assert a2tg.load_lpips.__module__ == "a2tg_jax.measure.metrics"


def test_a_renderer_prints_as_one_line():
    renderer = a2tg.Renderer(crowd())
    assert repr(renderer) == "Renderer(40 Gaussians, no size yet)"
    renderer(CAMERA)
    assert repr(renderer) == "Renderer(40 Gaussians, 16×12)"


def scene() -> a2tg.Scene:
    view = a2tg.View("a.png", CAMERA, np.zeros((12, 16, 3), np.uint8))
    points = np.random.default_rng(0).normal(size=(9, 3))
    return a2tg.Scene("toy", (view, view), (view,), points, 0 * points, some_world(), 1.0)


def fitted(**changes) -> a2tg.FitResult:
    whole = scene()
    return a2tg.fit(dataclasses.replace(whole, **{"train": whole.test, **changes}), a2tg.A2tg())


def stepped(rates):
    return a2tg.adam_update(GAUSSIANS, GAUSSIANS, a2tg.adam_init(GAUSSIANS), rates)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OneStage(a2tg.A2tg):
    def stages(self):
        return super().stages()[0]


MODEL, GAUSSIANS = a2tg.Model(some_gaussians()), some_gaussians()
TEXTURES = a2tg.allocate_textures(np.ones((7, 2), int))
TEXTURED = a2tg.Model(GAUSSIANS, a2tg.Appearance(texture=a2tg.Texture(TEXTURES)))
KINDS = {
    "scene must be a Scene; got str: say load_scene('/path')": lambda: a2tg.fit("/path", a2tg.A2tg()),
    "got a name: say find_system('a2tg')": lambda: a2tg.fit(scene(), "a2tg"),
    "system must be a System; got the class A2tg: say A2tg()": lambda: a2tg.fit(scene(), a2tg.A2tg),
    "resume must be a Checkpoint; got str: say load_checkpoint": lambda: a2tg.fit(
        scene(), a2tg.A2tg(), resume="cp.npz"
    ),
    "OneStage.stages must return a tuple of stages; got Stage(": lambda: a2tg.fit(scene(), OneStage()),
    "views must be views, such as scene.train; got Scene: say evaluate(scene.test": lambda: a2tg.evaluate(
        scene(), MODEL
    ),
    "got Model: say evaluate(scene.test, model)": lambda: a2tg.evaluate(MODEL, scene().test),
    "gaussians must be Gaussians; got Scene": lambda: a2tg.evaluate(scene().test, scene()),
    "got Scene: say polish(model, scene.train)": lambda: a2tg.polish(MODEL, scene()),
    "model must be a Model; got tuple: say polish": lambda: a2tg.polish(scene().train, MODEL),
    "cameras[0] must be a Camera; got View: use view.camera": lambda: a2tg.smooth_path(scene().train, 5),
    "cameras must be a Camera or an Iterable; got Scene": lambda: a2tg.smooth_path(scene(), 5),
    "model must be a Model; got Gaussians: say Model(gaussians)": lambda: a2tg.save_model("g.npz", GAUSSIANS),
    "model must be a Model; got Gaussians": lambda: a2tg.save_compact("g.a2tgz", GAUSSIANS),
    "model must be a Model; got ArrayImpl": lambda: a2tg.value_and_grad(jnp.sum)(jnp.ones(3)),
    "settings must be RenderSettings; got dict": lambda: MODEL.render(CAMERA, settings={"tile_size": 8}),
    "camera.viewmat must be an array; got tuple": lambda: MODEL.render(
        a2tg.Camera(tuple(np.eye(4)), tuple(np.eye(3)), 8, 8)
    ),
    "camera.width must be a positive number of pixels, a Python int": lambda: MODEL.render(
        dataclasses.replace(CAMERA, width=jnp.int32(80))
    ),
    "gaussians must be Gaussians; got Scen": lambda: a2tg.Model(scene()),
    "appearance must be an Appearance; got Textures: such as Appearance(texture=Texture(textures))": lambda: a2tg.Model(
        GAUSSIANS, TEXTURES
    ),
    "x.ply: save_model writes *.npz files; call save_ply instead": lambda: a2tg.save_model("x.ply", MODEL),
    "save_compact writes *.a2tgz files; call save_model": lambda: a2tg.save_compact("x.npz", MODEL),
    "save_ply writes *.ply files; call save_compact": lambda: a2tg.save_ply("x.a2tgz", MODEL),
    "flat.ply: load_model reads *.npz files; call load_ply instead": lambda: a2tg.load_model("flat.ply"),
    "load_compact reads *.a2tgz files; call load_model": lambda: a2tg.load_compact("m.npz"),
    "load_ply reads *.ply files; call load_model": lambda: a2tg.load_ply("m.npz"),
    "similarity must be a Similarity; got ndarray": lambda: MODEL.transform(np.eye(4)),
    "similarity.rotation must be an array; got list: use np.asarray": lambda: moved(rotation=[[1, 0, 0]]),
    "texture must be an Upscale; got dict: say Upscale(cap=8)": lambda: a2tg.A2tg(texture={"cap": 8}).check(),
    "must be an array uint8 [H, W, 3], or [H, W, 4] with alpha; got float64 [12, 16, 3]: say np.rint(255": lambda: (
        a2tg.View("a.png", CAMERA, np.zeros((12, 16, 3)))
    ),
    "with alpha; got uint8 [3, 12, 16]": lambda: a2tg.View("a.png", CAMERA, np.zeros((3, 12, 16), np.uint8)),
    "view a.png: a mask must be an array bool [H, W], True where pixels count; got list": lambda: dataclasses.replace(
        scene().test[0], mask=[[True]]
    ),
    "view a.png: a depth map must be an array of floats [H, W]; got list": lambda: dataclasses.replace(
        scene().test[0], depth=[[1.0]]
    ),
    "with alpha; got str": lambda: a2tg.View("a.png", CAMERA, "a.png"),
    "view a.png: camera must be a Camera; got": lambda: a2tg.View("a.png", None, np.zeros((12, 16, 3), np.uint8)),
    "view a.png: camera.viewmat must be [4, 4]; got [3, 4]": lambda: fitted(
        train=(dataclasses.replace(scene().test[0], camera=dataclasses.replace(CAMERA, viewmat=jnp.eye(4)[:3])),)
    ),
    "scene.train has two views called 'a.png': give each its own name": lambda: fitted(train=scene().test * 2),
    "scene.train must be a tuple of views; got (array([": lambda: fitted(train=(np.zeros(3),)),
    "scene.transform must be a Similarity; got NoneType": lambda: fitted(transform=None),
    "scene.transform must be a Similarity; got ndarray": lambda: fitted(transform=np.eye(4)),
    "scene.scale must be above 0": lambda: fitted(scale=0.0),
    "scene.points must hold at least two points; got 0": lambda: fitted(
        points=np.zeros((0, 3)), colors=np.zeros((0, 3))
    ),
    "scene.colors must be [9, 3]; got [2, 3]": lambda: fitted(colors=np.zeros((2, 3))),
    "A2tg.texture.cap is an unknown key; say texture={'cap': …}": lambda: a2tg.A2tg.preset(
        "quick", **{"texture.cap": 4}
    ),
    "and up is [0. 0. 1.]: pass another up": lambda: a2tg.look_at([0, 0, 1], [0, 0, 0], width=64, height=48),
    "is a folder; name a file": lambda: a2tg.load_model(tempfile.gettempdir()),
    "rates.sh must broadcast to [7, 16, 3] at equal rank; got [1, 4, 1]": lambda: stepped(
        a2tg.LearningRates().of_gaussians(1e-3, 1)
    ),
    "rates must be one for all, or have the fields of params": lambda: stepped({"means": 1e-3}),
    "background must be one of black, white, random; got 'grey'": lambda: a2tg.fit(
        scene(), a2tg.A2tg(background="grey")
    ),
    "corrections.exposure_kind must be one of ": lambda: a2tg.A2tg(
        corrections=Corrections(exposure_kind="foo")
    ).check(),
    "batch_size must be int; got '4'": lambda: a2tg.A2tg(batch_size="4").check(),
}


@pytest.mark.parametrize("message", KINDS)
def test_a_value_of_the_wrong_kind_is_named(message):
    with pytest.raises(ValueError, match=re.escape(message)):
        KINDS[message]()


def moved(**changes) -> a2tg.Model:
    return MODEL.transform(dataclasses.replace(a2tg.Similarity(1.0, np.eye(3), np.zeros(3)), **changes))


VALUES = {
    "num must be an int, at least 2; got 3.5": lambda: started(num=3.5),
    "num must be an int, at least 2; got True": lambda: started(num=True),
    "sh_degree must be an int, 0 to 3; got 4": lambda: started(sh_degree=4),
    "opacity must be above 0 and below 1; got 1.0": lambda: started(opacity=1.0),
    "opacity must be a number above 0 and below 1; got '0.1'": lambda: started(opacity="0.1"),
    "similarity must have a positive scale": lambda: moved(scale=0.0),
    "similarity must have a rotation; got [[-1.0": lambda: moved(rotation=-np.eye(3)),
    "similarity.rotation must be [3, 3]; got [4, 4]": lambda: moved(rotation=np.eye(4)),
    "similarity must have a positive scale and a finite translation": lambda: moved(translation=np.full(3, np.nan)),
    "gaussians must be float32 or float64; got bfloat16": lambda: a2tg.Model(
        jax.tree.map(lambda x: x.astype(jnp.bfloat16), GAUSSIANS)
    ).render(CAMERA),
    "no textures to replace in plain Gaussians: build a model with Appearance(texture=Texture(textures))": lambda: (
        MODEL.with_textures(TEXTURES)
    ),
}


def started(**arguments) -> a2tg.Gaussians:
    points = np.random.default_rng(0).normal(size=(9, 3))
    return a2tg.init_from_points(points, np.full((9, 3), 0.5), **arguments)


@pytest.mark.parametrize("message", VALUES)
def test_an_impossible_value_is_named(message):
    with pytest.raises(ValueError, match=re.escape(message)):
        VALUES[message]()


TEMPLATES = {
    "texture.texels": a2tg.Appearance(texture=a2tg.Texture()),
    "bands.coefficients": a2tg.Appearance(bands=Bands()),
    "exponents.shapes": a2tg.Appearance(exponents=Exponents()),
}


@pytest.mark.parametrize("field", TEMPLATES)
@pytest.mark.parametrize("needs", ["render", "live", "num_bytes", "save_model", "evaluate"])
def test_a_template_is_refused_where_its_arrays_are_needed(field, needs, tmp_path):
    calls = {
        "render": lambda model: model.render(CAMERA),
        "save_model": lambda model: a2tg.save_model(tmp_path / "m.npz", model),
        "evaluate": lambda model: a2tg.evaluate(scene().test, model),
    }
    model = jax.tree.map(lambda x: x, a2tg.Model(GAUSSIANS, TEMPLATES[field]))
    message = f"model.appearance.{field} is None: this appearance is a template, without arrays; say Model(gaussians, "
    with pytest.raises(ValueError, match=re.escape(message)):
        calls.get(needs, lambda model: getattr(model, needs))(model)


def test_numbers_of_numpy_and_jax_are_options():
    times = np.float32(0.25), 0.5
    for at in (times, np.array(times)):
        a2tg.A2tg(seed=np.int64(3), initial_opacity=jnp.float32(0.2), texture=a2tg.Upscale(at=at)).check()


def test_options_without_resolvable_annotations_are_not_looked_at():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Own(a2tg.A2tg):
        table: "OnlyInThisFunction" = ()  # type: ignore[name-defined] # noqa: F821

    Own().check()


def test_a_class_that_was_defined_anew_is_told_from_the_one_before():
    def defined() -> type[a2tg.System]:
        @dataclasses.dataclass(frozen=True, kw_only=True)
        class Own(a2tg.A2tg):
            pass

        return Own

    checkpoint = Checkpoint(defined()(), 0, None, History.empty())
    with pytest.raises(
        ValueError, match=r"Own as it was before it was defined again\): resume with checkpoint.system, or"
    ):
        check_resume(checkpoint, defined()(), 0)


def test_transformations_may_put_anything_in_the_place_of_gaussians():
    axes = a2tg.Model(0, None)
    assert jax.tree.map(lambda x: None, MODEL).gaussians.means is None and axes.gaussians == 0


def test_a_ply_file_with_nan_says_how_many_rows_and_which_first(tmp_path):
    bad = dataclasses.replace(GAUSSIANS, means=GAUSSIANS.means.at[jnp.array([2, 5]), 1].set(jnp.nan))
    message = r"means must be finite; 2 of 7 rows have NaN or infinite numbers, the first is row 2 \(from 0\)"
    with pytest.raises(ValueError, match=message):
        a2tg.save_ply(tmp_path / "bad.ply", bad)
    assert not (tmp_path / "bad.ply").exists()
    a2tg.save_ply(tmp_path / "good.ply", GAUSSIANS)
    header, rows = (tmp_path / "good.ply").read_bytes().split(b"end_header\n")
    numbers = np.frombuffer(rows, "<f4").reshape(GAUSSIANS.num, -1).copy()
    numbers[[2, 5], 1] = np.nan
    (tmp_path / "bad.ply").write_bytes(header + b"end_header\n" + numbers.tobytes())
    with pytest.warns(UserWarning, match=r"2 Gaussians of 7 left out, .* the first is row 2 \(from 0\)"):
        assert a2tg.load_ply(tmp_path / "bad.ply").num == 5


def test_a_preset_takes_other_values_of_options():
    system = a2tg.A2tg.preset("quick", stage1_iterations=10, texture={"cap": 8}, rates=a2tg.LearningRates(quats=0.5))
    plain = a2tg.A2tg.preset("quick")
    texture = dataclasses.replace(plain.texture, cap=8)
    rates = a2tg.LearningRates(quats=0.5)
    assert system == dataclasses.replace(plain, stage1_iterations=10, texture=texture, rates=rates)
    with pytest.raises(ValueError, match=r"A2tg.iterations is an unknown key; did you mean stage"):
        a2tg.A2tg.preset("quick", iterations=10)
    with pytest.raises(ValueError, match=r"A2tg.texture.cep is an unknown key; did you mean cap\?"):
        a2tg.A2tg.preset("quick", texture={"cep": 10})


def test_the_first_ctrl_c_is_noted_and_the_second_interrupts():
    with pytest.raises(KeyboardInterrupt), signals.noted((signals.CTRL_C,)) as is_interrupted:
        assert not is_interrupted()
        signal.raise_signal(signal.SIGINT)
        assert is_interrupted()
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_noted_ctrl_c_is_not_lost_at_the_end():
    with pytest.raises(KeyboardInterrupt), signals.noted((signals.CTRL_C,)):
        signal.raise_signal(signal.SIGINT)


ROWS = {
    "concatenate needs at least one model": lambda: a2tg.concatenate([]),
    "models[1] must be a Model; got Gaussians": lambda: a2tg.concatenate([MODEL, GAUSSIANS]),
    "models must have one appearance; got plain Gaussians and Gaussians with texture": lambda: a2tg.concatenate(
        [MODEL, TEXTURED]
    ),
    "models must have one appearance; got plain Gaussians of different options": lambda: a2tg.concatenate(
        [MODEL, a2tg.Model(GAUSSIANS, a2tg.Appearance(max_alpha=0.5))]
    ),
    "for one Gaussian say model[3:4]": lambda: MODEL[3],
    "for one Gaussian say model[-1:]": lambda: MODEL[-1],
    "background must be [3] floats, such as (1, 1, 1) for white; got 'white'": lambda: MODEL.render(
        CAMERA, background="white"
    ),
}


@pytest.mark.parametrize("message", ROWS)
def test_rows_models_and_backgrounds_of_a_wrong_form_are_named(message):
    with pytest.raises(ValueError, match=re.escape(message)):
        ROWS[message]()


def test_an_unknown_statistic_is_refused():
    model, camera = some_model(), a2tg.synthetic_scene(num_views=3, width=16, height=16, num_points=50).test[0].camera
    with pytest.raises(ValueError, match=r"^statistic must be one of position, screen, center; got 'foo'$"):
        a2tg.view_gradients(lambda model, output: output.color.sum(), model, camera, statistic="foo")


class Said(dict):
    """Names in advice: those of the library, and some values."""

    def __missing__(self, name):
        return getattr(a2tg, name)


ADVICE = {
    "synthetic scene": (lambda: a2tg.fit("synthetic", a2tg.A2tg()), a2tg.Scene),
    "scene folder": (lambda: a2tg.fit(Path("fox"), a2tg.A2tg()), a2tg.Scene),
    "name of a system": (lambda: a2tg.fit(scene(), "a2tg"), a2tg.System),
    "class of a system": (lambda: a2tg.fit(scene(), a2tg.A2tg), a2tg.System),
    "Gaussians": (lambda: a2tg.save_model("g.npz", GAUSSIANS), a2tg.Model),
    "template": (lambda: a2tg.Model(GAUSSIANS, TEMPLATES["texture.texels"]).live, a2tg.Model),
    "colours of 0 to 1": (lambda: a2tg.View("a", CAMERA, np.zeros((12, 16, 3))), np.ndarray),
    "one row": (lambda: MODEL[3], a2tg.Model),
    "last row": (lambda: MODEL[-1], a2tg.Model),
    "group of options": (lambda: a2tg.A2tg(texture={"cap": 8}).check(), a2tg.Upscale),
}


@pytest.mark.parametrize("mistake", ADVICE)
def test_what_a_message_says_to_write_works(mistake, tmp_path, monkeypatch):
    call, made = ADVICE[mistake]
    with pytest.raises(ValueError, match="say ") as told:
        call()
    monkeypatch.chdir(tmp_path)
    write_colmap(tmp_path / "fox")
    said = Said(gaussians=GAUSSIANS, model=MODEL, image=np.zeros((12, 16, 3)), np=np)
    said |= {"appearance": TEMPLATES["texture.texels"], "key": jax.random.key(0)}
    for code in str(told.value).rpartition("say ")[2].partition(" of ")[0].split(" or "):
        assert isinstance(eval(code, {}, said), made)


@pytest.mark.parametrize("row", [7, -8])
def test_a_row_that_no_model_has_gets_no_advice(row):
    with pytest.raises(ValueError, match=f"rows must choose among 7 Gaussians; got {row}$"):
        MODEL[row]


def test_the_built_in_scene_is_no_folder():
    with pytest.raises(FileNotFoundError, match=r"synthetic: no such scene folder; .* is synthetic_scene\(\)$"):
        a2tg.load_scene("synthetic")
