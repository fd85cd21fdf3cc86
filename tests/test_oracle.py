"""The oracle against values worked out by hand, and its statistic against differences."""

import numpy as np
import oracle
import pytest
from oracle import DEFAULT_RULES, Rules, Scene, lookup, render, shown_texture, splat_layer, splat_layers
from scenes_random import draw_scene

FOCAL = 20.0
FACING = [1.0, 0.0, 0.0, 0.0]
EDGE_ON = [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]


def hand_scene(means, quats, log_scales, opacities, colors, textures=None, background=(0.0, 0.0, 0.0)) -> Scene:
    """Splats of constant colour before a camera at the origin that looks along +z, 16×12 pixels."""
    opacities = np.array(opacities)
    sh = np.zeros((len(means), 16, 3))
    sh[:, 0] = (np.array(colors) - 0.5) * np.sqrt(4 * np.pi)
    splats = *(np.array(x, float) for x in (means, quats, log_scales)), np.log(opacities / (1 - opacities)), sh
    K = np.array([[FOCAL, 0, 8], [0, FOCAL, 6], [0, 0, 1]])
    return Scene(*splats, np.eye(4), K, 16, 12, textures, np.array(background))


def test_a_facing_splat_has_the_closed_form():
    scene = hand_scene([[0.1, -0.2, 4]], [FACING], [np.log([0.5, 0.8])], [0.7], [[0.2, 0.5, 0.9]], background=(1, 0, 0))
    image = render(scene)
    x, y = 3.5, 7.5
    u = ((x - 8) / FOCAL * 4 - 0.1) / 0.5
    v = ((y - 6) / FOCAL * 4 + 0.2) / 0.8
    alpha = 0.7 * np.exp(-(u * u + v * v) / 2)
    np.testing.assert_allclose(image.alpha[7, 3], alpha)
    np.testing.assert_allclose(image.color[7, 3], alpha * np.array([0.2, 0.5, 0.9]) + (1 - alpha) * np.array([1, 0, 0]))
    np.testing.assert_allclose(image.depth[7, 3], 4 * alpha)
    np.testing.assert_allclose(image.normal[7, 3], [0, 0, -alpha])


def test_an_edge_on_splat_is_a_spot_two_thirds_of_a_pixel_wide():
    image = render(hand_scene([[0, 0, 4]], [EDGE_ON], [[0.0, 0.0]], [0.9], [[1, 1, 1]]))
    np.testing.assert_allclose(image.alpha[6, 8], 0.9 * np.exp(-0.5))
    np.testing.assert_allclose(image.alpha[6, 9], 0.9 * np.exp(-2.5))
    np.testing.assert_allclose(image.depth[6, 8], 4 * image.alpha[6, 8])
    assert image.alpha[6, 11] == 0


def test_the_nearer_splat_hides_the_farther():
    scene = hand_scene([[0, 0, 5], [0, 0, 4]], [FACING] * 2, [[1.0, 1.0]] * 2, [0.6, 0.8], [[1, 0, 0], [0, 1, 0]])
    weights = render(scene).weights[:, 6, 8]
    far, near = (splat_layer(scene, i, DEFAULT_RULES).alpha[6, 8] for i in range(2))
    np.testing.assert_allclose(weights, [far * (1 - near), near])


def test_the_splat_that_would_end_a_pixel_is_left_out():
    scene = hand_scene([[0, 0, z] for z in (2, 3, 4, 5)], [FACING] * 4, [[3.0, 3.0]] * 4, [0.97] * 4, [[1, 1, 1]] * 4)
    image = render(scene)
    assert np.count_nonzero(image.weights[:, 6, 8]) == 2
    assert 1e-4 < 1 - image.alpha[6, 8] < 1e-2


def test_a_mean_nearer_than_the_near_plane_is_skipped():
    scene = hand_scene([[0, 0, 0.19]], [FACING], [[0.0, 0.0]], [0.9], [[1, 1, 1]])
    assert render(scene).alpha.max() == 0
    assert render(scene, Rules(near=0.18)).alpha.max() > 0.8


@pytest.mark.parametrize(
    ("rules", "u", "expected"),
    [
        (Rules(), -1.5, 0.0),
        (Rules(), 0.0, 0.5),
        (Rules(), 0.75, 0.75),
        (Rules(), 7.0, 1.0),
        (Rules(uv="align-corners"), -1.5, 0.25),
        (Rules(uv="align-corners"), -3.0, 0.0),
        (Rules(outside="identity"), -2.9, 0.0),
        (Rules(outside="identity"), -3.1, 1.0),
        (Rules(extent=1.5), -0.75, 0.0),
        (Rules(extent=1.5), 0.375, 0.75),
        (Rules(uv="align-corners", extent=1.5), -0.75, 0.25),
        (Rules(outside="identity", extent=1.5), -1.6, 1.0),
    ],
)
def test_lookup_along_two_texels(rules, u, expected):
    texture = np.zeros((1, 2, 4))
    texture[0, 1] = 1
    texel, _, _ = lookup(texture, np.array([[u]]), np.array([[0.0]]), rules)
    np.testing.assert_allclose(texel[0, 0, 3], expected)


def test_u_indexes_columns_and_unit_rgb_is_clamped_before_interpolation():
    texture = np.arange(6.0).reshape(2, 3, 1) * np.ones(4)
    texel, _, _ = lookup(texture, np.array([[2.0]]), np.array([[-1.5]]), Rules())
    np.testing.assert_allclose(texel[0, 0], 2)
    textures = [np.array([[[-1.0, 2.0, 0.5, 1.0], [1.0, 0.0, 0.5, 1.0]]])]
    scene = hand_scene([[0, 0, 4]], [FACING], [[0, 0]], [0.5], [[1, 1, 1]], textures)
    texture = shown_texture(scene, 0, Rules(rgb="unit"))
    texel, _, _ = lookup(texture, np.zeros((1, 1)), np.zeros((1, 1)), Rules(rgb="unit"))
    np.testing.assert_allclose(texel[0, 0], [0.5, 0.5, 0.5, 1.0])


def test_alpha_over_the_largest_of_all():
    textures = [np.full((1, 1, 4), -1.0), np.full((1, 2, 4), 3.0)]
    scene = hand_scene([[0, 0, 4]] * 2, [FACING] * 2, [[0, 0]] * 2, [0.5] * 2, [[1, 1, 1]] * 2, textures)
    shown = [shown_texture(scene, i, Rules(alpha="global-maximum"))[0, 0] for i in range(2)]
    np.testing.assert_allclose(shown, [[-1, -1, -1, 0], [3, 3, 3, 3 / 3.000001]])


def test_spherical_harmonics_are_orthonormal():
    cos_angles, weights = np.polynomial.legendre.leggauss(8)
    azimuths = np.arange(16) * np.pi / 8
    gram = np.zeros((16, 16))
    for cos_angle, weight in zip(cos_angles, weights, strict=True):
        for azimuth in azimuths:
            sin_angle = np.sqrt(1 - cos_angle**2)
            basis = oracle.sh_basis(np.array([sin_angle * np.cos(azimuth), sin_angle * np.sin(azimuth), cos_angle]))
            gram += np.outer(basis, basis) * weight * np.pi / 8
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-12)


def test_statistic_against_differences():
    """ε = 1e-6 in float64, moving ρ alone: order, colour, lookup and decisions stay as they were."""
    scene = draw_scene(3, num=20, width=9, height=7)
    cotangent = np.random.default_rng(0).normal(size=(7, 9, 3))
    base = splat_layers(scene)

    def objective(i, j, epsilon):
        means = scene.means.copy()
        means[i, j] += epsilon
        moved = splat_layer(scene._replace(means=means), i, DEFAULT_RULES, base[i].texel)
        is_free = (base[i].alpha > 0) & (moved.alpha > 0) & ~base[i].is_capped
        layers = list(base)
        layers[i] = base[i]._replace(alpha=np.where(is_free, moved.alpha, base[i].alpha))
        return np.sum(oracle.composite(layers, scene.background).color * cotangent, axis=-1)

    expected = [
        [np.sum(abs(objective(i, j, 1e-6) - objective(i, j, -1e-6))) / 2e-6 for j in range(3)] for i in range(20)
    ]
    statistic = oracle.gradient_statistic(scene, cotangent)
    assert np.count_nonzero(statistic) > 30
    np.testing.assert_allclose(statistic, expected, atol=1e-6)


@pytest.mark.parametrize("i", [1, 6, 10])
def test_gradients_of_rho_against_differences(i):
    """ε = 1e-6: M[0, 2] and M[1, 2], which by M[2, 2] are the projected mean; low-pass filter and hit apart."""
    scene = draw_scene(3, num=20, width=9, height=7)
    M, jacobian = oracle.homography(scene, i)
    hits = oracle.intersect(M, jacobian, 9, 7, 0.2)
    for axis in range(2):
        ends = []
        for step in (1e-6, -1e-6):
            moved = M.copy()
            moved[axis, 2] += step * M[2, 2]
            ends.append(oracle.intersect(moved, jacobian, 9, 7, 0.2).rho)
        found = hits.rho_gradients["screen"][..., axis] + hits.rho_gradients["center"][..., axis]
        expected = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * abs(expected).max())
