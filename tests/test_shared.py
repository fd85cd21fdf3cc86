"""Fields that Gaussians share: rows that move leave them, bytes count them once, and training goes on with them."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes_random import as_gaussians, draw_scene

import a2tg_jax as a2tg
from a2tg_jax.appearance.base import clear_rows
from a2tg_jax.densify.pruning import shown_in
from a2tg_jax.events import gather_rows
from a2tg_jax.training.cost import forecast_stages
from a2tg_jax.training.start import padded

NUM = 40
BYTES_OF_GAUSSIAN = 4 * (3 + 4 + 2 + 1 + 3 + 2)
"""Of degree 0, with a code of two numbers."""
SHARED_BYTES = 4 * (8 * 7 + 1)


@a2tg.pytree(kw_only=True)
class Painted(a2tg.Appearance):
    """A network of the place and of a code per Gaussian multiplies the colours."""

    codes: jax.Array | None = None
    """[N, 2]."""
    network: dict[str, jax.Array] | None = a2tg.shared()
    """"weights" [8, 7] of eight neurons, and "gain" []."""

    def allocate(self, key, gaussians):
        network = {"weights": 0.3 * jax.random.normal(key, (8, 7)), "gain": jnp.zeros(())}
        return dataclasses.replace(self, codes=jnp.zeros((gaussians.num, 2)), network=network)

    def numbers(self, gaussians, camera):
        flat = jnp.concatenate([self.network["gain"][None], self.network["weights"].reshape(-1)])
        return jnp.concatenate([self.codes, jnp.broadcast_to(flat, (gaussians.num, len(flat)))], axis=1)

    def shade(self, numbers, values, u, v):
        first, second, gain, *weights = numbers
        logs = [gain] * 3
        for i in range(0, len(weights), 7):
            of_u, of_v, of_first, of_second, *outputs = weights[i : i + 7]
            neuron = jnp.tanh(of_u * u + of_v * v + of_first * first + of_second * second)
            logs = [log + output * neuron for log, output in zip(logs, outputs, strict=True)]
        return None, None, tuple(jnp.exp(log) for log in logs)


@a2tg.pytree(kw_only=True)
class Codebook(a2tg.Appearance):
    """Each Gaussian shows one of eight textures."""

    index: jax.Array | None = None
    """[N] int32."""
    texels: jax.Array | None = a2tg.shared()
    """[8, 4, 4, 3]."""

    def allocate(self, key, gaussians):
        index = jnp.arange(gaussians.num, dtype=jnp.int32) % 8
        return dataclasses.replace(self, index=index, texels=0.1 * jax.random.normal(key, (8, 4, 4, 3)))

    def atlas(self):
        side = jnp.full_like(self.index, 4)
        return self.texels.reshape(-1, 3), a2tg.TextureRegion(16 * self.index, side, side)

    def texel_position(self, region, u, v):
        return jnp.clip((u + 2) * 0.75, 0, 3), jnp.clip((v + 2) * 0.75, 0, 3)

    def shade(self, numbers, values, u, v):
        return values, None


@a2tg.pytree(kw_only=True)
class Unshared(a2tg.Appearance):
    """A field without rows that is not declared as shared."""

    weights: jax.Array | None = None

    def allocate(self, key, gaussians):
        return dataclasses.replace(self, weights=jnp.zeros((1, 51)))


APPEARANCES = {"painted": Painted(), "codebook": Codebook(), "unshared": Unshared()}
EVENTS = {
    "none": (),
    "mcmc": (a2tg.Noise(), a2tg.Mcmc(cap=70), a2tg.Prune(at=(0.3, 0.6))),
    "density": (a2tg.CloneSplitPrune(cap=70, threshold=1e-5), a2tg.OpacityReset()),
    "splitting": (a2tg.SplitByGradient(cap=90), a2tg.PlaceByError(at=(0.5,), cap=90)),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Own(a2tg.System):
    """One stage."""

    stage1_iterations: int = 40
    shown: str = "painted"
    events: str = "none"
    shared_rate: float = 1e-2
    """0: only the fields with rows learn."""

    name = "own"

    def stages(self):
        rates = {"network": self.shared_rate, "codes": 1e-2} if self.shown == "painted" else 1e-2
        stage = a2tg.Stage(
            self.shown, APPEARANCES[self.shown], EVENTS[self.events], a2tg.LossConfig(ssim_weight=0.0).terms(),
            self.rates, self.stage1_iterations, rates,
        )  # fmt: skip
        return (stage,)


def some_model() -> a2tg.Model:
    gaussians = as_gaussians(draw_scene(2, num=NUM), "float32")
    gaussians = dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])
    appearance = a2tg.allocate_appearance(Painted(), jax.random.key(0), gaussians)
    return a2tg.Model(gaussians, dataclasses.replace(appearance, codes=jnp.arange(2.0 * NUM).reshape(NUM, 2)))


def with_gain(model: a2tg.Model, gain: float) -> a2tg.Model:
    network = {**model.appearance.network, "gain": jnp.asarray(gain)}
    return dataclasses.replace(model, appearance=dataclasses.replace(model.appearance, network=network))


def assert_same(found, wanted) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(one, other)


@functools.cache
def laws() -> dict:
    model = some_model()
    rows = np.array([7, 3, 3, 0])
    repeated = np.resize(rows, NUM)
    system = Own(events="density")
    spare = padded(model, system.stages()[0], system)
    return {
        "taken": (model[rows], rows),
        "gathered": (gather_rows(model, repeated), repeated),
        "gathered under jit": (jax.jit(gather_rows)(model, repeated), repeated),
        "joined": (a2tg.concatenate([model[:5], model[9:12]]), np.r_[:5, 9:12]),
        "padded": (dataclasses.replace(spare, num_live=None)[:NUM], np.arange(NUM)),
        "moved": (model.transform(a2tg.Similarity(2.0, np.eye(3), np.ones(3))), np.arange(NUM)),
    }


@pytest.mark.parametrize("name", ["taken", "gathered", "gathered under jit", "joined", "padded", "moved"])
def test_rows_that_move_leave_what_is_shared(name):
    model = some_model()
    changed, rows = laws()[name]
    assert_same(changed.appearance.network, model.appearance.network)
    np.testing.assert_array_equal(changed.appearance.codes, model.appearance.codes[rows])


def test_moments_of_what_is_shared_are_not_cleared():
    model = some_model()
    cleared = clear_rows(model.appearance, jnp.ones(NUM, bool))
    assert_same(cleared.network, model.appearance.network)
    np.testing.assert_array_equal(cleared.codes, 0)


def test_models_that_share_other_numbers_are_not_joined():
    model = some_model()
    with pytest.raises(ValueError, match="network must be equal in all models"):
        a2tg.concatenate([model, with_gain(model, 0.5)])


def test_bytes_count_what_is_shared_once():
    model = some_model()
    assert model.bytes_of(0) == SHARED_BYTES
    assert model.num_bytes == NUM * BYTES_OF_GAUSSIAN + SHARED_BYTES
    assert model[:3].num_bytes == 3 * BYTES_OF_GAUSSIAN + SHARED_BYTES
    assert model.num_padding_bytes == 0 and dataclasses.replace(model, num_live=jnp.int32(30)).num_padding_bytes == 80


def test_a_budget_has_room_for_what_is_shared():
    scene = a2tg.synthetic_scene(num_views=3, width=16, height=16, num_points=50)
    budget = (100 * BYTES_OF_GAUSSIAN + SHARED_BYTES + BYTES_OF_GAUSSIAN - 1) / 1e6
    system = Own(memory_budget=budget, sh_degree=0)
    assert system.budget_cap(2, SHARED_BYTES // 4) == 100 and system.budget_cap(2) > 100
    system.check_given_number(100)
    with pytest.raises(ValueError, match="has room for 100 Gaussians of 60 bytes"):
        system.check_given_number(101)
    (found,) = forecast_stages(scene, system)
    assert found.model_bytes == 50 * BYTES_OF_GAUSSIAN + SHARED_BYTES


def test_a_field_without_rows_is_named_before_training():
    scene = a2tg.synthetic_scene(num_views=3, width=16, height=16, num_points=50)
    with pytest.raises(
        ValueError, match=r"Unshared\.weights must have a row for each Gaussian; .*a2tg_jax\.shared\(\)"
    ):
        a2tg.fit(scene, Own(shown="unshared", sh_degree=0))


@pytest.mark.parametrize("kind", ["painted", "codebook"])
def test_files_keep_what_is_shared(kind, tmp_path):
    model = some_model()
    if kind == "codebook":
        appearance = a2tg.allocate_appearance(Codebook(), jax.random.key(1), model.gaussians)
        model = dataclasses.replace(model, appearance=appearance)
    a2tg.save_model(tmp_path / "model.npz", model)
    kinds = (Painted, Codebook)
    loaded = a2tg.load_model(tmp_path / "model.npz", appearances=kinds)
    assert_same(loaded, model)
    assert loaded.num_bytes == model.num_bytes
    with pytest.raises(ValueError, match="save_model keeps any model"):
        a2tg.save_compact(tmp_path / "model.a2tgz", model)


@a2tg.pytree
class Layer:
    weights: jax.Array


@a2tg.pytree(kw_only=True)
class Layered(a2tg.Appearance):
    """A field and an array in it whose paths have the word by which files of version 0.2 named arrays."""

    inner: Layer | None = a2tg.shared()
    spinner: Layer | None = None

    def allocate(self, key, gaussians):
        rows = Layer(jnp.arange(2.0 * gaussians.num).reshape(-1, 2))
        return dataclasses.replace(self, inner=Layer(jnp.arange(3.0)), spinner=rows)


def test_files_keep_fields_of_any_name(tmp_path):
    gaussians = some_model().gaussians
    model = a2tg.Model(gaussians, a2tg.allocate_appearance(Layered(), jax.random.key(0), gaussians))
    a2tg.save_model(tmp_path / "model.npz", model)
    assert_same(a2tg.load_model(tmp_path / "model.npz", appearances=(Layered,)), model)


@a2tg.pytree(kw_only=True)
class Shapely(a2tg.Appearance):
    """A field that would be taken for the shapes of kernels."""

    shapes: jax.Array | None = None

    def allocate(self, key, gaussians):
        return dataclasses.replace(self, shapes=jnp.ones(gaussians.num))


@pytest.mark.parametrize(
    ("template", "message"),
    [
        (Codebook(texture=a2tg.Texture()), r"Codebook\.texels must have another name: files have texels of"),
        (Shapely(), r"Shapely\.shapes must have another name: it replaces Appearance\.shapes"),
    ],
)
def test_names_of_fields_that_are_taken(template, message, tmp_path):
    """Numbers would replace the textures in files, or act as the shapes of kernels."""
    gaussians = some_model().gaussians
    model = a2tg.Model(gaussians, a2tg.allocate_appearance(template, jax.random.key(0), gaussians))
    stage = dataclasses.replace(Own().stages()[0], appearance=template)
    for use in (stage.check, lambda: a2tg.save_model(tmp_path / "model.npz", model)):
        with pytest.raises(ValueError, match=message):
            use()


def test_a_file_with_other_shared_numbers_is_refused(tmp_path):
    model = some_model()
    network = {**model.appearance.network, "weights": jnp.zeros((9, 7))}
    other = dataclasses.replace(model.appearance, network=network)
    a2tg.save_model(tmp_path / "model.npz", dataclasses.replace(model, appearance=other))
    with pytest.raises(ValueError, match=r"network\['weights'\] must be \[8, 7\]; got \[9, 7\]"):
        a2tg.load_model(tmp_path / "model.npz", appearances=(Painted,))


@pytest.mark.filterwarnings("ignore:stage painted. .* times there was no room")
@pytest.mark.parametrize("events", ["mcmc", "density", "splitting"])
def test_training_with_events_learns_and_resumes(events, tmp_path):
    """A checkpoint in a file continues to the same bits, moments of what is shared included."""
    scene = a2tg.synthetic_scene(num_views=3, width=24, height=18, num_points=50)
    system = Own(events=events, sh_degree=0)
    path = tmp_path / "checkpoint.npz"
    kept = []

    def save(checkpoint):
        if checkpoint.iteration == 25:
            a2tg.save_checkpoint(path, checkpoint)
            kept.append(jax.device_get(checkpoint.state.moments))

    result = a2tg.fit(scene, system, on_checkpoint=save, checkpoint_every=25)
    history = result.history
    network = result.model.appearance.network
    assert history.loss[-1] < 0.8 * history.loss[0] and (history.num_gaussians != 50).any()
    assert abs(float(network["gain"])) > 1e-3
    resume = a2tg.load_checkpoint(path, Own)
    assert_same(resume.state.moments, kept[0])
    assert all(map(np.any, jax.tree.leaves(kept[0].mu.appearance.network)))
    assert_same(a2tg.fit(scene, system, resume=resume).model, result.model)


def test_a_field_learns_at_a_rate_of_its_own():
    scene = a2tg.synthetic_scene(num_views=3, width=16, height=16, num_points=50)
    still, learned = (
        a2tg.fit(scene, Own(sh_degree=0, stage1_iterations=3, shared_rate=rate)).model.appearance
        for rate in (0.0, 1e-2)
    )
    assert float(still.network["gain"]) == 0 != float(learned.network["gain"]) and np.any(still.codes)


def test_gradients_of_a_batch_of_models_and_of_views():
    """`vmap` over models maps what is shared like any array; `value_and_grad` differentiates it."""
    scene = a2tg.synthetic_scene(num_views=3, width=16, height=16, num_points=50)
    camera = scene.train[0].camera
    model = some_model()
    settings = a2tg.plan_render(model, camera, head_room=2)
    brightness = lambda model: jnp.mean(model.render(camera, settings=settings).color)  # noqa: E731
    several = [with_gain(model, gain) for gain in (0.0, 0.4)]
    stacked = jax.tree.map(lambda *each: jnp.stack(each), *several)
    found = jax.vmap(brightness)(stacked)
    np.testing.assert_allclose(found, [brightness(each) for each in several], rtol=1e-5)
    value, gradient = a2tg.value_and_grad(brightness)(several[1])
    difference = (brightness(with_gain(model, 0.41)) - brightness(with_gain(model, 0.39))) / 0.02
    np.testing.assert_allclose(gradient.appearance.network["gain"], difference, rtol=2e-3)
    # The tint is exp(gain): all colour but the background grows with it.
    np.testing.assert_allclose(value, found[0] * np.exp(0.4), rtol=1e-5)


@a2tg.pytree(kw_only=True)
class ByDegree(a2tg.Appearance):
    """The active degree as a colour."""

    def numbers_at(self, gaussians, camera, degree):
        return jnp.full((gaussians.num, 1), degree, gaussians.means.dtype)

    def shade(self, numbers, values, u, v):
        return (numbers[0],) * 3, None, (u * 0,) * 3


@pytest.mark.parametrize("degree", [0, 2])
def test_numbers_get_the_active_degree(degree):
    scene = a2tg.synthetic_scene(num_views=3, width=16, height=16, num_points=50)
    settings = a2tg.RenderSettings(sh_degree=degree)
    model = dataclasses.replace(some_model(), appearance=ByDegree())
    output = model.render(scene.train[0].camera, settings=settings, background=jnp.zeros(3))
    np.testing.assert_allclose(output.color, degree * output.alpha[..., None].repeat(3, axis=2), atol=1e-6)


def test_weights_for_pruning_are_those_of_plain_splats():
    """Σ α·T does not depend on the tint."""
    scene = a2tg.synthetic_scene(num_views=3, width=16, height=16, num_points=50)
    model = some_model()
    plain = dataclasses.replace(model, appearance=a2tg.Appearance())
    found, wanted = (shown_in(each, a2tg.Due(views=scene.train)).weights for each in (with_gain(model, -3.0), plain))
    assert wanted.max() > 1
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("parts", [{"texture": a2tg.Texture()}, {"exponents": a2tg.Exponents()}, {"max_alpha": 0.9}])
@pytest.mark.parametrize("cap", [NUM, NUM + 20])
def test_a_stage_with_other_parts_keeps_the_arrays_of_the_class(parts, cap):
    model = with_gain(some_model(), 0.5)
    stage = dataclasses.replace(Own().stages()[0], appearance=Painted(**parts), events=(a2tg.Mcmc(cap=cap),))
    found = padded(model, stage, Own()).appearance
    np.testing.assert_array_equal(found.codes[:NUM], model.appearance.codes)
    assert found.codes.shape == (cap, 2) and not found.codes[NUM:].any()
    assert_same(found.network, model.appearance.network)
    assert found.max_alpha == parts.get("max_alpha")
    assert (found.textures is not None) == ("texture" in parts)


def test_a_stage_keeps_parts_of_the_same_options():
    """Of a model with textures and shapes, also if the stage's class is another."""
    model = some_model()
    textures = a2tg.allocate_textures(np.full((NUM, 2), 2), rgb=0.25)
    shown = a2tg.Appearance(texture=a2tg.Texture(textures), max_alpha=0.8)
    template = Painted(texture=a2tg.Texture(), exponents=a2tg.Exponents())
    stage = dataclasses.replace(Own().stages()[0], appearance=template)
    found = padded(dataclasses.replace(model, appearance=shown), stage, Own()).appearance
    assert_same(found.textures, textures)
    assert found.codes.shape == (NUM, 2) and found.shapes.shape == (NUM,)


def test_arrays_of_other_shapes_are_begun_again_with_a_warning():
    model = some_model()
    shown = dataclasses.replace(model.appearance, codes=jnp.ones((NUM, 3)))
    stage = dataclasses.replace(Own().stages()[0], appearance=Painted(texture=a2tg.Texture()))
    with pytest.warns(UserWarning, match=r"stage 'painted' begins with new Painted\.codes"):
        found = padded(dataclasses.replace(model, appearance=shown), stage, Own()).appearance
    assert found.codes.shape == (NUM, 2)
    assert_same(found.network, model.appearance.network)
