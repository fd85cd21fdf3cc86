"""Rendering where several devices each render a view, in a process that has rendered nothing before."""

import os
import subprocess
import sys

SCRIPT = """
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec as P
from a2tg_jax import Camera, RenderSettings, init_from_points, render_image

gaussians = init_from_points([[0, 0, 2], [0.1, 0, 2], [0, 0.1, 2]], [[1, 1, 1]] * 3)
mesh = jax.make_mesh((2,), ("views",), axis_types=(jax.sharding.AxisType.Auto,))
viewmats = jnp.stack([jnp.eye(4), jnp.eye(4).at[0, 3].set(0.1)])

def show(gaussians, viewmat):
    camera = Camera(viewmat, jnp.asarray([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 16, 16)
    return render_image(gaussians, camera, settings=RenderSettings(capacity=1024, compositor="native")).color

def shown(gaussians, viewmats, check_vma):
    one = lambda gaussians, viewmats: show(gaussians, viewmats[0])[None]
    specs = dict(mesh=mesh, in_specs=(P(), P("views")), out_specs=P("views"), check_vma=check_vma)
    return jax.shard_map(one, **specs)(gaussians, viewmats)

def loss(gaussians, viewmats, check_vma):
    return jnp.sum(shown(gaussians, viewmats, check_vma) ** 2)

found = jax.jit(shown, static_argnums=2)(gaussians, viewmats, True)
expected = jnp.stack([show(gaussians, viewmat) for viewmat in viewmats])
np.testing.assert_allclose(found, expected, atol=1e-6)
assert expected.max() > 0.05 and jnp.abs(found[0] - found[1]).max() > 0.01
wanted = jax.grad(lambda g: sum(jnp.sum(show(g, viewmat) ** 2) for viewmat in viewmats))(gaussians)
for check_vma in (True, False):
    gradient = jax.jit(jax.grad(loss), static_argnums=2)(gaussians, viewmats, check_vma)
    np.testing.assert_allclose(gradient.means, wanted.means, rtol=1e-3, atol=1e-4)

from a2tg_jax.training.losses import mean_ssim

photo = jnp.linspace(0, 1, 32 * 32 * 3).reshape(32, 32, 3)
photos = jnp.stack([photo**2, photo**3])
means = lambda photo, photos: jax.vmap(mean_ssim, in_axes=(None, 0))(photo, photos)
both = jax.shard_map(means, mesh=mesh, in_specs=(P(), P("views")), out_specs=P("views"))
wanted, found = (jax.grad(lambda x, f=f: jnp.sum(f(x, photos)))(photo) for f in (means, both))
np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-7)

def as_if_equal(gaussians, viewmats):
    one = lambda gaussians, viewmats: show(gaussians, viewmats[0])
    return jax.shard_map(one, mesh=mesh, in_specs=(P(), P("views")), out_specs=P())(gaussians, viewmats)

try:
    as_if_equal(gaussians, viewmats)
except ValueError as error:
    assert "out_specs" in str(error)
else:
    raise AssertionError("pictures that differ between devices passed for one")
"""


def test_the_first_rendering_may_be_inside_a_shard_map(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2")
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
