"""OpenUSD: what a model shows comes back as planar Gaussians, usd-core's own rules hold, no damaged file does harm."""

import dataclasses
import sys

import numpy as np
import pytest
from small_values import matrix_of, some_gaussians, some_world
from test_compact import MODELS, plain, textured
from test_gltf import assert_shows_the_same

from a2tg_jax import Model, Similarity, load_usd, save_usd
from a2tg_jax.io import usd_fields
from a2tg_jax.io.other_programs import joined_parts, upright

pxr = pytest.importorskip("pxr", reason="usd-core is missing: pip install 'a2tg-jax[usd]'")
from pxr import Gf, Usd, UsdGeom, UsdValidation, UsdVol, Vt  # noqa: E402

SUFFIXES = (".usda", ".usdc", ".usdz", ".usd")


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", ["plain 4", "textured", "banded 0"])
def test_models_come_back(tmp_path, name, suffix):
    model = MODELS[name]()
    path = tmp_path / f"a b{suffix}"
    model = dataclasses.replace(model, origin=dataclasses.replace(model.origin, transform=some_world()))
    save_usd(path, model)
    found = load_usd(path)
    assert_shows_the_same(found, model)
    assert found.origin == model.origin and found.textures is None
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_a_background_without_cameras_comes_back(tmp_path):
    model = Model(some_gaussians(), background=(0.25, 0.5, 1.0))
    save_usd(tmp_path / "m.usda", model)
    found = load_usd(tmp_path / "m.usda")
    assert found.background == model.background and found.origin is None


@pytest.mark.parametrize("ellipsoids", [False, True])
def test_the_stage_is_as_the_schema_says(tmp_path, ellipsoids):
    path = tmp_path / "m.usdc"
    model = plain(9)
    model = dataclasses.replace(model, origin=dataclasses.replace(model.origin, transform=some_world()))
    save_usd(path, model, ellipsoids=ellipsoids)
    stage = Usd.Stage.Open(str(path))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20 and not UsdValidation.ValidationContext(validators).Validate(stage)
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    (prim,) = [prim for prim in stage.Traverse() if prim.IsA(UsdVol.ParticleField)]
    kernels = [UsdVol.ParticleFieldKernelGaussianSurfletAPI, UsdVol.ParticleFieldKernelGaussianEllipsoidAPI]
    assert [prim.HasAPI(kernel) for kernel in kernels] == [not ellipsoids, ellipsoids]
    matrix = UsdGeom.XformCache().GetLocalToWorldTransform(prim)
    np.testing.assert_allclose(np.transpose(matrix), matrix_of(upright(model.origin, "z")), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(matrix) ** (-1 / 3), some_world().scale)
    harmonics = UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI(prim)
    assert harmonics.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 2
    coefficients = np.asarray(harmonics.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    np.testing.assert_array_equal(coefficients, model.sh.reshape(-1, 3))
    opacities = UsdVol.ParticleFieldOpacityAttributeAPI(prim).GetOpacitiesAttr().Get()
    np.testing.assert_allclose(opacities, model.gaussians.opacities, rtol=1e-5)
    first = UsdVol.ParticleFieldOrientationAttributeAPI(prim).GetOrientationsAttr().Get()[0]
    quat = np.asarray(model.gaussians.quats[0])
    np.testing.assert_allclose([first.real, *first.imaginary], quat / np.linalg.norm(quat), atol=1e-6)
    assert_shows_the_same(load_usd(path), model)


def stage_of(gaussians, kernel=UsdVol.ParticleFieldKernelGaussianSurfletAPI, up="Y", unit=0.01):
    """A particle field of another program: halves, y up, centimetres, and only some attributes."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    field = UsdVol.ParticleField.Define(stage, "/Splats")
    for name in ("Position", "Scale", "Orientation", "Opacity", "SphericalHarmonics"):
        getattr(UsdVol, f"ParticleField{name}AttributeAPI").Apply(field.GetPrim())
    if kernel is not None:
        kernel.Apply(field.GetPrim())
    means = np.asarray(gaussians.means)
    UsdVol.ParticleFieldPositionAttributeAPI(field).CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(means))
    scales = np.concatenate([np.asarray(gaussians.scales), np.ones((gaussians.num, 1))], axis=1).astype(np.float16)
    UsdVol.ParticleFieldScaleAttributeAPI(field).CreateScaleshAttr(Vt.Vec3hArray.FromNumpy(scales))
    return stage, field


def test_fields_of_other_programs(tmp_path):
    gaussians = some_gaussians()
    path = str(tmp_path / "m.usda")
    stage, field = stage_of(gaussians)
    field.AddTranslateOp().Set(Gf.Vec3d(100, 0, 0))
    stage.GetRootLayer().Export(path)
    found = load_usd(path)
    wanted = joined_parts([(Model(gaussians), matrix_of(Similarity(0.01, np.eye(3), np.array([1.0, 0, 0]))))], "y")
    np.testing.assert_allclose(found.gaussians.means, wanted.gaussians.means, atol=1e-6)
    # The normal of a surflet is z, whatever its scale.
    np.testing.assert_allclose(found.gaussians.scales, 0.01 * gaussians.scales, rtol=1e-3)
    np.testing.assert_allclose(found.gaussians.sh, 0)
    assert found.gaussians.sh_degree == 0 and (np.asarray(found.gaussians.opacities) > 1 - 1e-6).all()
    assert np.ptp(np.asarray(found.gaussians.quats), axis=0).max() < 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda stage, field: stage.RemovePrim(field.GetPath()), "holds no splats"),
        (lambda stage, field: field.AddScaleOp().Set(Gf.Vec3f(1, 2, 1)), "scales its axes differently"),
        (lambda stage, field: field.AddScaleOp().Set(Gf.Vec3f(0, 0, 0)), "must not scale by 0"),
        (
            lambda stage, field: field.GetPrim().GetAttribute("positions").Set(Vt.Vec3fArray([Gf.Vec3f(np.nan)])),
            "means must be finite",
        ),
        (lambda stage, field: field.GetPrim().SetCustomDataByKey("a2tg:origin", "[["), "damaged|Expecting"),
        (lambda stage, field: field.GetPrim().SetCustomDataByKey("a2tg:origin", "{}"), "damaged"),
    ],
)
def test_fields_that_lie_are_refused(tmp_path, change, message):
    path = tmp_path / "m.usda"
    stage, field = stage_of(some_gaussians())
    change(stage, field)
    stage.GetRootLayer().Export(str(path))
    refused(path, message)


@pytest.mark.parametrize("value", [np.nan, 1e13])
def test_particles_that_cannot_be_drawn_are_left_out_and_counted(tmp_path, value):
    gaussians = some_gaussians()
    stage, field = stage_of(gaussians)
    positions = np.array(gaussians.means)
    positions[2, 1] = value
    field.GetPrim().GetAttribute("positions").Set(Vt.Vec3fArray.FromNumpy(positions))
    stage.GetRootLayer().Export(str(tmp_path / "m.usda"))
    with pytest.warns(UserWarning, match=rf"m\.usda: 1 Gaussian of {gaussians.num} left out.*first is row 2"):
        assert load_usd(tmp_path / "m.usda").num == gaussians.num - 1


def test_a_degree_without_coefficients_takes_no_memory(tmp_path):
    path = tmp_path / "m.usda"
    stage, field = stage_of(some_gaussians())
    UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI(field).CreateRadianceSphericalHarmonicsDegreeAttr(2**31 - 1)
    stage.GetRootLayer().Export(str(path))
    assert load_usd(path).gaussians.sh_degree == 0


def test_degree_4_is_read_to_degree_3(tmp_path):
    path = tmp_path / "m.usda"
    gaussians = some_gaussians()
    sh = np.random.default_rng(0).normal(size=(gaussians.num, 25, 3)).astype(np.float32)
    stage, field = stage_of(gaussians)
    harmonics = UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI(field)
    harmonics.CreateRadianceSphericalHarmonicsDegreeAttr(4)
    coefficients = Vt.Vec3fArray.FromNumpy(sh.reshape(-1, 3))
    harmonics.CreateRadianceSphericalHarmonicsCoefficientsAttr(coefficients)
    stage.GetRootLayer().Export(str(path))
    with pytest.warns(UserWarning, match=r"m\.usda: has SH of degree 4; degree 3 is read"):
        found = load_usd(path)
    np.testing.assert_array_equal(found.sh[:, 0], sh[:, 0])  # The constant ones, which the file's axes leave alone.
    assert found.gaussians.sh_degree == 3


def test_other_kernels_are_refused(tmp_path):
    path = tmp_path / "m.usda"
    for kernel in (None, UsdVol.ParticleFieldKernelConstantSurfletAPI):
        stage, _ = stage_of(some_gaussians(), kernel)
        stage.GetRootLayer().Export(str(path))
        refused(path, "its particle field /Splats must have a kernel of Gaussians")


def refused(path, match):
    with pytest.raises(ValueError, match=match) as caught:
        load_usd(path)
    assert path.name in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 700


@pytest.mark.parametrize("suffix", SUFFIXES[:3])
def test_files_that_are_cut_off(tmp_path, suffix):
    path = tmp_path / f"m{suffix}"
    save_usd(path, textured())
    data = path.read_bytes()
    for share in (0.0, 0.01, 0.5, 0.99):
        path.write_bytes(data[: int(share * len(data))])
        refused(path, "not a USD file, or is damaged|holds no splats")
    path.write_bytes(b"")
    refused(path, r"damaged \((?!.*(Error in|\.cpp))")
    with pytest.raises(FileNotFoundError, match="no such USD file"):
        load_usd(tmp_path / f"none{suffix}")


def test_a_file_that_ends_usd_core_is_refused(tmp_path, monkeypatch):
    save_usd(tmp_path / "m.usdc", Model(some_gaussians(3)))
    crash = tmp_path / "crash.py"
    crash.write_text("import ctypes; ctypes.string_at(0)")
    monkeypatch.setattr(usd_fields, "__file__", str(crash))
    with pytest.raises(ValueError, match=r"m\.usdc: .*is damaged \(usd-core ended with status -11\)"):
        load_usd(tmp_path / "m.usdc")


def test_without_usd_core_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ValueError, match=r"pip install 'a2tg-jax\[usd\]'"):
        save_usd(tmp_path / "m.usda", plain())


def test_a_model_keeps_its_place_in_the_original_world():
    """Lengths are those of the original world, and up is up."""
    model = plain()
    assert joined_parts([(model, matrix_of(upright(model.origin, "z")))], "z") is model
