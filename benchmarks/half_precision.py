"""PSNR of a trained model whose texels and spherical harmonics are rounded to half precision, as a GPU might read them.

    python -m benchmarks.half_precision RUN

RUN is a run folder. Bytes are those of one read of the model in the forward pass.
"""

import argparse
import dataclasses
import pathlib

import jax.numpy as jnp

import a2tg_jax as a2tg
from a2tg_jax.results.folder import RunFolder
from a2tg_jax.results.record import read_record

NAMES = {"float16": jnp.float16, "bfloat16": jnp.bfloat16}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=pathlib.Path)
    run = RunFolder(parser.parse_args().run)
    a2tg.configure_cpu()
    record = read_record(run)
    scene, model = record.scene.load(), a2tg.load_model(run.model(record.plan.main[-1]))
    psnr = a2tg.evaluate(scene.test, model).psnr
    print(f"float32: {psnr:.4f} dB, {model.num_bytes:,} bytes")
    for name, dtype in NAMES.items():
        for what in ("texels", "SH", "texels and SH"):
            changed, saved = rounded(model, dtype, what)
            loss = psnr - a2tg.evaluate(scene.test, changed).psnr
            print(f"{what} as {name}: {loss:+.4f} dB lost, {saved / model.num_bytes:.0%} of the bytes saved")


def rounded(model: a2tg.Model, dtype, what: str) -> tuple[a2tg.Model, int]:
    """Return the model with some numbers rounded to a dtype, and the bytes that this saves."""

    def in_half(leaf):
        return leaf.astype(dtype).astype(leaf.dtype)

    saved = 0
    if "texels" in what and model.textures is not None:
        buckets = tuple(map(in_half, model.textures.buckets))
        model = model.with_textures(dataclasses.replace(model.textures, buckets=buckets))
        saved += 2 * 4 * model.textures.num_texels
    if "SH" in what:
        sh = in_half(model.gaussians.sh)
        model = dataclasses.replace(model, gaussians=dataclasses.replace(model.gaussians, sh=sh))
        saved += 2 * model.num * sh[0].size
    return model, saved


if __name__ == "__main__":
    main()
