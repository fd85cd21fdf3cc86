"""Compare native loops with XLA on ARM Linux; on another machine with Debian, install and run there under QEMU.

    python benchmarks/arm_linux.py FOLDER

Debian's packages (QEMU, and Python with its libraries for arm64) and the wheels of this package and its requirements
are unpacked in FOLDER, about 1.5 GB; nothing else of the machine changes. It takes about half an hour.
"""

import os
import pathlib
import platform
import subprocess
import sys

ROOT = pathlib.Path(__file__).parents[1]
DEBIAN = ("python3.11", "libstdc++6")
NUM, WIDTH, HEIGHT = 400, 96, 64


def main(folder: pathlib.Path) -> None:
    """Compare here, or install for ARM and compare there."""
    if platform.machine() == "aarch64":
        return compare()
    import ensurepip  # Debian's Python has none.

    folder.mkdir(parents=True, exist_ok=True)
    python = emulated_python(folder.absolute())
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, ROOT)
    wheel = max(folder.glob("a2tg_jax-*.whl"), key=lambda path: path.stat().st_mtime)
    # Under QEMU, pip chooses wheels and requirements for ARM as it does there.
    pip = next(pathlib.Path(ensurepip.__file__).parent.glob("_bundled/pip-*.whl")) / "pip"
    site = folder.absolute() / "site"
    options = ("--quiet", "--only-binary", ":all:", "--no-compile", "--upgrade", "--target", site)
    run(*python, pip, "install", *options, f"{wheel.absolute()}[train]")
    os.environ["PYTHONPATH"] = str(site)
    run(*python, "-m", "a2tg_jax", "doctor")
    run(*python, "-P", __file__, folder)  # -P: not the modules of this folder.


def emulated_python(folder: pathlib.Path) -> list[str]:
    """Unpack QEMU and Python for ARM with the libraries that it needs; return the command that starts it."""
    root, state = folder / "root", folder / "apt"
    (state / "lists/partial").mkdir(parents=True, exist_ok=True)
    (state / "archives/partial").mkdir(parents=True, exist_ok=True)
    (state / "status").touch()  # Nothing is installed yet.
    options = {"Dir::State": state, "Dir::State::status": state / "status", "Dir::Cache": state}
    options |= {"APT::Architecture": "arm64", "APT::Architectures": "arm64", "APT::Install-Recommends": "false"}
    apt = ["apt-get", "-qq", *(f"-o{name}={value}" for name, value in options.items())]
    run(*apt, "update")
    run(*apt, "--yes", "--download-only", "install", *DEBIAN)
    run("apt-get", "-qq", "download", "qemu-user-static", cwd=state)
    for package in (*state.glob("archives/*.deb"), *state.glob("*.deb")):
        run("dpkg-deb", "--extract", package, root)
    return [str(root / "usr/bin/qemu-aarch64-static"), "-L", str(root), str(root / "usr/bin/python3.11")]


def run(*words: object, cwd: pathlib.Path | None = None) -> None:
    """Run a command that must succeed."""
    subprocess.run([str(word) for word in words], check=True, cwd=cwd)


def compare() -> None:
    """Print the largest differences of image and gradients between native loops and XLA."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    import a2tg_jax as a2tg

    scene = a2tg.synthetic_scene(num_views=3, width=WIDTH, height=HEIGHT, num_points=NUM)
    gaussians, camera = a2tg.init_from_points(scene.points, scene.colors), scene.train[0].camera
    textures = a2tg.allocate_textures(np.tile([[1, 1], [2, 2], [4, 2]], (NUM // 3 + 1, 1))[:NUM])

    def render(gaussians, textures, compositor):
        settings = a2tg.RenderSettings(capacity=1 << 16, compositor=compositor)
        return a2tg.render_image(gaussians, camera, textures, settings=settings).color

    def loss(gaussians, textures, compositor):
        return jnp.sum(render(gaussians, textures, compositor) ** 2)

    gradient = jax.grad(loss, argnums=(0, 1), allow_int=True)
    native, xla = (
        {"image": render(gaussians, textures, name), "gradients": gradient(gaussians, textures, name)}
        for name in ("native", "xla")
    )
    print(platform.machine(), platform.python_version(), "jax", jax.__version__)
    for what in native:
        print(f"{what}: {difference(native[what], xla[what]):.1e}, as a share of the largest value of each array")


def difference(found, expected) -> float:
    """Return the largest difference between two pytrees' arrays of floats, as a share of each array's largest value."""
    import jax
    import numpy as np

    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    floats = [(np.asarray(a), np.asarray(b)) for a, b in pairs if np.issubdtype(a.dtype, np.floating)]
    return max(float(abs(a - b).max() / max(abs(b).max(), 1e-30)) for a, b in floats)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
