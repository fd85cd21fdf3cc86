"""Run `a2tg doctor` for ARM Linux on another machine with Debian, under QEMU: it compares native loops with XLA.

    python benchmarks/arm_linux.py FOLDER

Debian's packages (QEMU, and Python with its libraries for arm64) and the wheels of this package and its requirements
are unpacked in FOLDER, about 1.5 GB; nothing else of the machine changes. It takes about half an hour.
"""

import os
import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).parents[1]
DEBIAN = ("python3.11", "libstdc++6")


def main(folder: pathlib.Path) -> None:
    """Install the package for ARM, and call it there."""
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


def emulated_python(folder: pathlib.Path) -> list[str]:
    """Unpack QEMU and Python for ARM with the libraries that it needs; return the command that starts it."""
    root = folder / "root"
    state = folder / "apt"
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


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
