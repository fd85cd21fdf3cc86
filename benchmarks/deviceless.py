"""Compile kernels and training steps for a GPU on a machine without one, and print the memory that they need.

    pip install --no-deps jax-cuda13-plugin==X.Y.Z jax-cuda13-pjrt==X.Y.Z     # of the installed jax X.Y.Z
    python -m benchmarks.deviceless h200.txtpb --ptxas ptxas

The argument is XLA's description of the GPU (openxla/xla, xla/backends/gpu/target_config/specs). Nothing is executed.
With ptxas, registers and spills of each kernel are printed beside the temporary memory of the whole program. Of a step,
launches are the kernels that XLA starts one after the other. Without a GPU, XLA compiles a sort as one launch of a slow
kernel; on a GPU it is a few launches of CUB's. A branch is a place where the step waits for the host.
"""

import argparse
import collections
import functools
import os
import pathlib
import re
import subprocess
import tempfile

NUM_GAUSSIANS, NUM_PAIRS = 1_000_000, 10_000_000
WIDTH, HEIGHT, TILE_SIZE = 1920, 1088, 16
STEPS = (("plain", "gaussians-2d-mcmc", 0, 500_000), ("textured", "a2tg", 1, 1_000_000))
"""Name, system and stage of each step, and the number of Gaussians."""
STEP_SIZE = 1600, 1060
SIDES, SHARES = (1, 2, 4), (0.7, 0.2, 0.1)
"""Sides of the textures of a step, and the share of the Gaussians with each."""
LAUNCH = re.compile(r"^  \S.*? = .*? (fusion|custom-call|copy|sort|while|conditional)\(", re.MULTILINE)
SPILLS = re.compile(r"(\d+) bytes spill stores, (\d+) bytes spill loads")
REGISTERS = re.compile(r"Used (\d+) registers")
NAMES = re.compile(r"Compiling entry function '(\w+)'")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", type=pathlib.Path)
    parser.add_argument("--ptxas", help="NVIDIA's assembler, for registers and spills")
    args = parser.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    for name, kernel, function, inputs, spec in programs():
        compiled = compile_for(args.target, function, inputs)
        memory = compiled.memory_analysis().temp_size_in_bytes / 1e6
        registers = assembled(spec, args.ptxas)[kernel] if args.ptxas else ""
        print(f"{name:32s} temporary memory {memory:6.1f} MB  {registers}", flush=True)
    for name, system, stage, num in STEPS:
        compiled = compile_for(args.target, *step(system, stage, num), donate_argnums=(2,))
        memory, kinds = compiled.memory_analysis(), launches(compiled.as_text())
        sizes = memory.argument_size_in_bytes / 1e9, memory.temp_size_in_bytes / 1e9
        branches = kinds.get("conditional", 0) + kinds.get("while", 0)
        told = f"{sum(kinds.values()) - branches} launches, {branches} branches, state {sizes[0]:.2f} GB"
        print(f"{f'step, {name}, {num:,}':32s} {told}, temporary memory {sizes[1]:.2f} GB", flush=True)


def launches(text: str) -> dict[str, int]:
    """Return the number of instructions of the entry computation that start work on the GPU, by their kind."""
    entry = text[text.index("\nENTRY ") :]
    return collections.Counter(LAUNCH.findall(entry[: entry.index("\n}")]))


def step(name: str, index: int, num: int):
    """Return the training step of a stage between two events, and the shapes of its arguments."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from a2tg_jax.texture import allocate_textures
    from benchmarks.workload import training_step

    sizes = np.repeat(np.random.default_rng(0).choice(SIDES, (num, 1), p=SHARES), 2, axis=1)
    made = training_step(name, index, num, STEP_SIZE, allocate_textures(sizes), capacity=10 * num, compositor="cuda")
    return made.run, jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(jnp.shape(leaf), jnp.result_type(leaf)), made.given)


def programs():
    """Yield names, kernels, functions, shapes of their arguments, and specs: both passes, plain and textured."""
    import jax
    import jax.numpy as jnp

    from a2tg_jax.appearance import Appearance, StaticShading, Texture
    from a2tg_jax.core.bilinear import TextureRegion
    from a2tg_jax.rasterize.compositor import composite
    from a2tg_jax.rasterize.splats import PassSettings, Splats
    from a2tg_jax.rasterize.tiles import TileGrid, TileLists

    num, grid = NUM_GAUSSIANS, TileGrid(WIDTH, HEIGHT, TILE_SIZE)
    floats = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.float32)  # noqa: E731
    integers = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.int32)  # noqa: E731
    splats = Splats(floats(num, 3, 3), floats(num, 3), floats(num), floats(num, 3), floats(num, 0))
    lists = TileLists(integers(NUM_PAIRS), integers(grid.num + 1), floats(), jax.ShapeDtypeStruct((), jnp.bool_))
    texels, regions = floats(4 * num, 4), TextureRegion(*(integers(num),) * 3)
    plain, textured = (StaticShading.of(Appearance(texture=texture)) for texture in (None, Texture()))

    for name, static, *places in (("plain", plain, floats(1, 0), None), ("textured", textured, texels, regions)):
        for statistic in (None, "position"):
            columns = places[0].shape[1]
            shown = static, 0, columns, 3, "float32", grid, 0.2, False, statistic
            settings = PassSettings(*shown, compositor="cuda", tile_batch=1)
            spec = settings.kernel
            inputs = splats, *places, floats(num), lists, floats(3, 3), floats(num, 4)

            def forward(*inputs, settings=settings):
                return composite(settings, *inputs)

            def backward(splats, texels, regions, cutoff, lists, jacobian, probe, settings=settings):
                def loss(splats, texels, probe):
                    inputs = splats, texels, regions, cutoff, lists, jacobian, probe
                    channels, transmittance = composite(settings, *inputs)
                    return jnp.sum(channels) + jnp.sum(transmittance)

                return jax.grad(loss, argnums=(0, 1, 2))(splats, texels, probe)

            if not statistic:
                yield f"{name}, forward", "forward", forward, inputs, spec
            yield f"{name}, backward{' with statistic' if statistic else ''}", "backward", backward, inputs, spec


def compile_for(target: pathlib.Path, function, inputs, **options):
    """Return the program for the GPU that the file describes."""
    import jax
    from jax.experimental import topologies

    topology = topologies.get_topology_desc(platform="cuda", target_config=target.read_text(), topology="1x1x1")
    mesh = topologies.make_mesh(topology, (1,), ("x",))
    sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    placed = jax.tree.map(lambda s: jax.ShapeDtypeStruct(s.shape, s.dtype, sharding=sharding), inputs)
    return jax.jit(function, **options).lower(*placed).compile()


@functools.cache
def assembled(spec, ptxas: str) -> dict[str, str]:
    """Return registers and spills of the kernels of a spec, by name."""
    from a2tg_jax.rasterize.kernels.cuda import composite, nvrtc
    from a2tg_jax.rasterize.kernels.cuda.source import source

    capability = composite.DEFAULT_CAPABILITY
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "tiles.ptx"
        path.write_text(nvrtc.ptx(source(spec, "cuda"), capability), encoding="utf-8")
        command = [ptxas, f"-arch=sm_{capability.replace('.', '')}", "-v", str(path), "-o", os.devnull]
        log = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    figures = zip(NAMES.findall(log), REGISTERS.findall(log), SPILLS.findall(log), strict=True)
    return {name: f"{used} registers, {int(a) + int(b)} bytes spilled" for name, used, (a, b) in figures}


if __name__ == "__main__":
    main()
