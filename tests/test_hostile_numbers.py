"""Models whose numbers float32 does not carry, or that are no files: refused; at the limits they are drawn."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hostile_files import put
from small_models import some_gaussians, some_model
from test_hostile_models import GAUSSIANS, refused, spoiled, with_number

import a2tg_jax as a2tg
from a2tg_jax import load_compact, load_ply, save_compact, save_gltf, save_ply
from a2tg_jax.io import ply
from a2tg_jax.io.model_file import FORMAT as MODEL, load_model, save_model
from a2tg_jax.model import Model
from a2tg_jax.rasterize.views import render_traced
from a2tg_jax.renderer import plan_render


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(
            (name, value)
            for name in (*GAUSSIANS, "appearance/texels")
            for value in (1e38, -2e12)
            if name != "log_scales"
        ),
        ("log_scales", 28.0),
        ("log_scales", 80.0),
        ("log_scales", -1e38),
    ],
)
def test_models_with_numbers_that_are_too_large(tmp_path, name, value):
    path = tmp_path / "m.npz"
    save_model(path, some_model())
    spoiled(path, MODEL, with_number(name, value))
    field = name.removeprefix("appearance/")
    limit = "up to 27.63" if value in (28.0, 80.0) else r"within ±1e\+12; got"
    refused(load_model, path, rf"{field}.* {limit}")


def test_numbers_at_the_limit_are_drawn_and_have_gradients(tmp_path):
    gaussians = some_gaussians()
    extreme = dataclasses.replace(
        gaussians,
        means=gaussians.means.at[0].set(jnp.asarray([1e12, -1e12, 1e12])).at[1].set(jnp.asarray([0, 0, 1e12])),
        log_scales=gaussians.log_scales.at[2].set(27.6),
        quats=gaussians.quats.at[3].set(1e12),
        sh=gaussians.sh.at[4].set(1e12),
    )
    save_model(tmp_path / "m.npz", Model(extreme))
    model = load_model(tmp_path / "m.npz")
    viewmat = jnp.eye(4).at[2, 3].set(4.0)
    camera = a2tg.Camera(viewmat, jnp.asarray([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]]), 32, 24)

    settings = plan_render(extreme, [camera], appearance=model.appearance)

    def brightness(gaussians):
        return render_traced(gaussians, camera, model.appearance, jnp.zeros(3), settings)[0].color.sum()

    gradient = jax.grad(brightness)(model.gaussians)
    assert np.isfinite(np.asarray(model.render(camera).color)).all()
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("value", [1e38, -1e13])
def test_files_with_numbers_that_are_too_large(tmp_path, monkeypatch, value):
    gaussians = some_gaussians()
    gaussians = dataclasses.replace(gaussians, means=gaussians.means.at[0, 0].set(value))
    with monkeypatch.context() as patch:
        patch.setattr(ply, "check_model", lambda model: None)
        save_ply(tmp_path / "g.ply", gaussians)
    refused(load_ply, tmp_path / "g.ply", r"gaussians\.means must lie within ±1e\+12; got")
    for save, name in ((save_model, "m.npz"), (save_compact, "m.a2tgz"), (save_ply, "m.ply"), (save_gltf, "m.glb")):
        with pytest.raises(ValueError, match=r"gaussians\.means must lie within ±1e\+12; got"):
            save(tmp_path / name, Model(gaussians))
        assert not (tmp_path / name).exists()


@pytest.mark.parametrize("name", ["m.npz", "m.a2tgz", "m.ply"])
@pytest.mark.parametrize("kind", ["device", "pipe", "sparse"])
def test_models_that_are_no_files(tmp_path, name, kind):
    load = {"m.npz": load_model, "m.a2tgz": load_compact, "m.ply": load_ply}[name]
    put(tmp_path / name, kind)
    refused(load, tmp_path / name, "is not a regular file" if kind != "sparse" else "has 100,000,000,000 bytes")
