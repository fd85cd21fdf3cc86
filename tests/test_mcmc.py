"""MCMC against its closed forms: the binomial sum, the kept centre, the frequencies of the hosts, the counts."""

import decimal
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import logit
from small_values import rotations

from a2tg_jax import AdamState, Gaussians, adam_init, grow, perturb, relocate
from a2tg_jax.core.gaussians import share, stacked_integral
from a2tg_jax.mcmc import draw_hosts

KEY = jax.random.key(0)
NUM = 64
jit_relocate = jax.jit(relocate)
jit_grow = jax.jit(grow)


def random_gaussians(num, seed=0, opacities=None, dtype=np.float32):
    """Gaussians with the given opacities, or with some in every decade."""
    rng = np.random.default_rng(seed)
    opacities = rng.uniform(0.05, 0.95, num) if opacities is None else np.asarray(opacities)
    return Gaussians(
        means=jnp.asarray(rng.normal(size=(num, 3)), dtype),
        quats=jnp.asarray(rng.normal(size=(num, 4)), dtype),
        log_scales=jnp.asarray(rng.normal(-3, 1, (num, 2)), dtype),
        logit_opacities=logit(jnp.asarray(opacities, dtype)),
        sh=jnp.asarray(rng.normal(size=(num, 16, 3)), dtype),
    )


def ones_like_moments(gaussians):
    """(mu, nu), all ones."""
    ones = jax.tree.map(jnp.ones_like, gaussians)
    return ones, ones


def binomial_sum(opacity: float, num: int) -> float:
    """S as 3DGS-MCMC writes it, in 60 decimal digits because its terms cancel."""
    with decimal.localcontext(prec=60):
        o = decimal.Decimal(opacity)
        terms = (
            math.comb(i - 1, k) * (-1) ** k * o ** (k + 1) / decimal.Decimal(k + 1).sqrt()
            for i in range(1, num + 1)
            for k in range(i)
        )
        return float(sum(terms))


OPACITIES = [0.005, 0.05, 0.3, 0.7, 0.95, 0.999, 1 - 2**-23]
SHARES = [1, 2, 3, 7, 20, 51]


@pytest.mark.parametrize("dtype, rtol", [(np.float32, 1e-6), (np.float64, 1e-9)])
def test_integral_equals_the_binomial_sum(x64, dtype, rtol):
    opacities, shares = (x.ravel() for x in np.meshgrid(np.asarray(OPACITIES, dtype), SHARES))
    wanted = [binomial_sum(float(o), int(n)) for o, n in zip(opacities, shares, strict=True)]
    got = stacked_integral(jnp.asarray(opacities), jnp.asarray(shares))
    assert got.dtype == dtype
    np.testing.assert_allclose(got, wanted, rtol=rtol)


def test_shares_keep_the_centre_and_the_line_integral(x64):
    opacities = np.repeat([0.3, 0.7, 0.95, 0.999], 4)
    shares = np.tile([2, 3, 7, 51], 4)
    log_scales = np.random.default_rng(0).normal(size=(16, 2))
    logits, scaled = share(logit(jnp.asarray(opacities)), jnp.asarray(log_scales), jnp.asarray(shares))
    copies = np.asarray(jax.nn.sigmoid(logits))
    np.testing.assert_allclose(1 - (1 - copies) ** shares, opacities, rtol=1e-10)
    ratio = np.exp(np.asarray(scaled) - log_scales)
    x = np.linspace(-12, 12, 4001)
    stack = 1 - (1 - copies[:, None] * np.exp(-((x / ratio[:, :1]) ** 2))) ** shares[:, None]
    np.testing.assert_allclose(np.trapezoid(stack, x, axis=1), opacities * math.sqrt(math.pi), rtol=1e-8)
    np.testing.assert_allclose(ratio[:, 0], ratio[:, 1], rtol=1e-14)


def test_shares_are_clamped_and_finite_in_float32():
    logits = jnp.asarray([-5.2, -5.2, 40.0, 40.0])
    got, scaled = share(logits, jnp.zeros((4, 2)), jnp.asarray([1, 51, 1, 2]))
    np.testing.assert_array_equal(got[jnp.asarray([0, 2])], logits[jnp.asarray([0, 2])])
    np.testing.assert_allclose(jax.nn.sigmoid(got[1]), 0.005, rtol=1e-6)
    assert jax.nn.sigmoid(got[3]) <= 1 - 2**-24
    assert np.isfinite(got).all() and np.isfinite(scaled).all()


def dead_and_live(num=NUM, num_live=40, num_dead=15):
    """Rows 0, 2, 4, … are dead; each row past the live ones is opaque, to tempt the drawing."""
    opacities = np.random.default_rng(1).uniform(0.05, 0.9, num)
    dead = 2 * np.arange(num_dead)
    opacities[dead] = 0.004
    opacities[num_live:] = 0.99
    return random_gaussians(num, opacities=opacities), dead, num_live


def find_hosts(before, after, rows):
    """The row that each of `rows` was copied from, told by the mean."""
    equal = (np.asarray(after.means)[rows][:, None] == np.asarray(before.means)[None]).all(-1)
    assert (equal.sum(1) == 1).all()
    return equal.argmax(1)


def check_copies(before, after, rows, hosts):
    """Rows and their hosts carry the shared opacity and size, and all else of the host."""
    shares = np.bincount(hosts, minlength=before.num) + 1
    logits, log_scales = share(before.logit_opacities, before.log_scales, jnp.asarray(shares))
    for target, source in ((rows, hosts), (hosts, hosts)):
        np.testing.assert_allclose(after.logit_opacities[target], logits[source], rtol=1e-5)
        np.testing.assert_allclose(after.log_scales[target], log_scales[source], rtol=1e-5)
        for name in ("means", "quats", "sh"):
            np.testing.assert_array_equal(getattr(after, name)[target], getattr(before, name)[source])


def check_untouched(before, after, touched):
    """All rows but the touched ones are as before."""
    rest = np.setdiff1d(np.arange(before.num), touched)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[rest], b[rest]), before, after)


def test_relocate_moves_every_dead_row_onto_live_hosts():
    gaussians, dead, num_live = dead_and_live()
    moved, moments, live_after, info = jit_relocate(KEY, gaussians, ones_like_moments(gaussians), num_live)
    hosts = find_hosts(gaussians, moved, dead)
    assert (hosts < num_live).all() and not np.isin(hosts, dead).any()
    assert (moved.opacities[:num_live] > 0.005).all()
    assert (int(live_after), int(info.num_dead), int(info.num_added), bool(info.has_hosts)) == (num_live, 15, 0, True)
    check_copies(gaussians, moved, dead, hosts)
    check_untouched(gaussians, moved, np.concatenate([dead, hosts]))
    is_zero = np.isin(np.arange(gaussians.num), hosts)
    for leaf in jax.tree.leaves(moments):
        np.testing.assert_array_equal(np.asarray(leaf).reshape(gaussians.num, -1).max(1), np.where(is_zero, 0, 1))


def test_relocation_preserves_the_opacity_at_the_centre_and_stops_at_51_shares():
    """One host, three dead rows: four equal copies, which composite to the host's own opacity."""
    gaussians = random_gaussians(NUM, opacities=[0.9] + [0.001] * 63)
    moved = jit_relocate(KEY, gaussians, ones_like_moments(gaussians), 4).gaussians[:4]
    np.testing.assert_allclose(1 - np.prod(1 - np.asarray(moved.opacities, np.float64)), 0.9, rtol=1e-6)
    np.testing.assert_array_equal(moved.means, np.tile(gaussians.means[0], (4, 1)))
    gaussians = random_gaussians(NUM, opacities=[0.999] + [0.001] * 63)
    moved = jit_relocate(KEY, gaussians, ones_like_moments(gaussians), NUM).gaussians
    np.testing.assert_allclose(moved.opacities, 1 - 0.001 ** (1 / 51), rtol=1e-4)


@pytest.mark.parametrize("num_live", [0, 10])
def test_without_hosts_nothing_changes_and_it_is_said(num_live):
    gaussians = random_gaussians(NUM, opacities=[0.001] * 10 + [0.9] * 54)
    moments = ones_like_moments(gaussians)
    for result in (jit_relocate(KEY, gaussians, moments, num_live), jit_grow(KEY, gaussians, moments, num_live, NUM)):
        assert not result.info.has_hosts and result.num_live == num_live
        jax.tree.map(np.testing.assert_array_equal, (result.gaussians, result.moments), (gaussians, moments))


def test_growth_counts():
    gaussians = random_gaussians(NUM)
    counts = ((1, 64, 2), (19, 64, 20), (40, 64, 42), (59, 64, 61), (40, 41, 41), (64, 64, 64))
    for num_live, cap, wanted in counts:
        result = jit_grow(KEY, gaussians, ones_like_moments(gaussians), num_live, cap)
        assert (int(result.num_live), int(result.info.num_added)) == (wanted, wanted - num_live)


def test_growth_copies_hosts_into_new_rows_with_zero_moments():
    gaussians, dead, num_live = dead_and_live()
    grown, moments, live_after, _ = jit_grow(KEY, gaussians, ones_like_moments(gaussians), num_live, NUM)
    rows = np.arange(num_live, int(live_after))
    hosts = find_hosts(gaussians, grown, rows)
    assert (hosts < num_live).all() and not np.isin(hosts, dead).any()
    check_copies(gaussians, grown, rows, hosts)
    check_untouched(gaussians, grown, np.concatenate([rows, hosts]))
    is_zero = np.isin(np.arange(gaussians.num), np.concatenate([rows, hosts]))
    for leaf in jax.tree.leaves(moments):
        np.testing.assert_array_equal(np.asarray(leaf).reshape(gaussians.num, -1).max(1), np.where(is_zero, 0, 1))


def test_bad_arguments_are_named():
    gaussians = random_gaussians(8)
    for cap in (-1, 9, 7.5):
        with pytest.raises(ValueError, match=rf"cap must be a whole number in 0\.\.8; got {cap}"):
            grow(KEY, gaussians, (), 4, cap)
    for step in (relocate, functools.partial(grow, cap=8)):
        with pytest.raises(ValueError, match=r"adam_init\(gaussians\), or arrays with 8 rows; got moments\['count'\]"):
            step(KEY, gaussians, {"count": jnp.zeros(())}, 4)
        with pytest.raises(ValueError, match=r"got moments\[0\].means of shape \[9, 3\]"):
            step(KEY, gaussians, adam_init(random_gaussians(9)), 4)
        for num_live in (-1, 9, 4.5):
            with pytest.raises(ValueError, match=rf"num_live must be a whole number in 0\.\.8; got {num_live}"):
                step(KEY, gaussians, (), num_live)
    with pytest.raises(ValueError, match=r"scales must be \[8, 2\]; got \[3\]"):
        perturb(KEY, gaussians, 8, 1e-4, jnp.ones(3))


def test_noise_takes_scales_in_lists():
    gaussians = random_gaussians(8)
    noisy = perturb(KEY, gaussians, 8, 1e-4, np.asarray(gaussians.scales).tolist())
    np.testing.assert_array_equal(noisy.means, perturb(KEY, gaussians, 8, 1e-4).means)


@pytest.mark.parametrize("step", [relocate, lambda *args: grow(*args, NUM)], ids=["relocate", "grow"])
def test_the_state_of_adam_moves_like_its_moments(step):
    gaussians, *_ = dead_and_live()
    mu, nu = ones_like_moments(gaussians)
    state = AdamState(mu, jax.tree.map(lambda leaf: 2 * leaf, nu), jnp.int32(7))
    found = step(KEY, gaussians, state, 40)
    wanted = step(KEY, gaussians, (state.mu, state.nu), 40)
    assert isinstance(found.moments, AdamState) and int(found.moments.count) == 7
    moved = found._replace(moments=(found.moments.mu, found.moments.nu))
    jax.tree.map(np.testing.assert_array_equal, moved, wanted)


@pytest.mark.parametrize("step", [relocate, lambda *args: grow(*args, NUM)], ids=["relocate", "grow"])
def test_one_trace_serves_every_live_count(step):
    traces = []
    traced = jax.jit(lambda *args: traces.append(None) or step(*args))
    gaussians, *_ = dead_and_live()
    moments = ones_like_moments(gaussians)
    for num_live in (10, 40, 63):
        gaussians, moments, *_ = traced(KEY, gaussians, moments, num_live)
    assert len(traces) == 1


def test_hosts_are_drawn_in_proportion_to_their_opacity():
    """χ² over 50 hosts at a fixed seed, with rows between them that must never be drawn."""
    num = 40_000
    rng = np.random.default_rng(0)
    is_host = np.zeros(num, bool)
    is_host[rng.choice(num, 50, replace=False)] = True
    opacities = rng.uniform(0.006, 1, num).astype(np.float32)
    counts = np.bincount(jax.jit(draw_hosts)(KEY, jnp.asarray(opacities), jnp.asarray(is_host)), minlength=num)
    assert counts[~is_host].sum() == 0
    expected = num * opacities[is_host] / opacities[is_host].sum()
    chi_square = ((counts[is_host] - expected) ** 2 / expected).sum()
    assert chi_square < 49 + 4 * math.sqrt(2 * 49)


def test_a_million_small_weights_keep_their_probability():
    """Half the rows have opacity 0.01, half 0.9: a single float32 sum has steps as large as the small weights."""
    num = 1_000_000
    opacities = jnp.where(jnp.arange(num) % 2 == 0, 0.01, 0.9)
    hosts = np.asarray(jax.jit(draw_hosts)(KEY, opacities, jnp.ones(num, bool)))
    num_small = (hosts % 2 == 0).sum()
    expected = num * 0.01 / 0.91
    assert abs(num_small - expected) < 4 * math.sqrt(expected)
    # The draws spread evenly over the whole range: Poisson counts in 100 bins, their upper end included.
    bins = np.bincount(hosts // 10_000, minlength=100)
    assert ((bins - 10_000.0) ** 2 / 10_000).sum() < 99 + 4 * math.sqrt(2 * 99)
    # Distinct rows drawn among the opaque: 1 - e^-m of them, m the mean number of draws of each.
    mean = (num - expected) / (num / 2)
    distinct = len(np.unique(hosts[hosts % 2 == 1])) / (num / 2)
    np.testing.assert_allclose(distinct, 1 - math.exp(-mean), rtol=5e-3)


def test_a_single_row_is_its_own_host_and_no_rows_stay_none():
    assert draw_hosts(KEY, jnp.asarray([0.5]), jnp.asarray([True])) == 0
    none = random_gaussians(0)
    for step in (relocate, functools.partial(grow, cap=0)):
        moved = step(KEY, none, ones_like_moments(none), 0)
        assert moved.gaussians.num == 0 and int(moved.num_live) == 0


def test_noise_lies_in_the_plane_with_the_splats_covariance(x64):
    """Many copies of one transparent splat: covariance Σ·Σᵀ times the squared strength; none along its normal."""
    num = 20_000
    one = random_gaussians(1, opacities=[0.006], dtype=np.float64)
    gaussians = jax.tree.map(lambda x: jnp.repeat(x, num, axis=0), one)
    shift = np.asarray(jax.jit(perturb)(KEY, gaussians, num, 1e-3).means - gaussians.means)
    rotation = rotations(one.quats)[0]
    sigma = rotation @ np.diag([*np.asarray(one.scales[0]) ** 2, 0]) @ rotation.T
    strength = 1e-3 * 5e5 / (1 + math.exp(-100 * ((1 - 0.006) - 0.995)))
    np.testing.assert_allclose(shift @ rotation[:, 2], 0, atol=1e-12 * np.abs(shift).max())
    wanted = strength**2 * sigma @ sigma.T
    np.testing.assert_allclose(np.cov(shift.T), wanted, atol=0.03 * np.abs(wanted).max())


def test_noise_spares_opaque_and_unused_rows():
    gaussians = random_gaussians(4, opacities=[0.9, 0.004, 0.004, 0.004])
    moved = jax.jit(perturb)(KEY, gaussians, 3, 1.6e-4)
    shift = np.abs(np.asarray(moved.means - gaussians.means)).max(1)
    assert shift[0] < 1e-6 and (shift[1:3] > 1e-6).all() and shift[3] == 0
    for name in ("quats", "log_scales", "logit_opacities", "sh"):
        np.testing.assert_array_equal(getattr(moved, name), getattr(gaussians, name))
