"""PLY files as SuperSplat packs them: numbers come back within half a step, and no damaged file is believed."""

import numpy as np
import pytest
from small_values import SH_C0

from a2tg_jax import load_ply
from a2tg_jax.data.ply import PlyFile
from a2tg_jax.io.ply import unpacked_vertices

NUM = 300
"""More than a chunk, and no whole number of them."""
BOUNDS = [f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
COLOR_BOUNDS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]


def some_rows(num: int = NUM) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    quats = rng.normal(size=(num, 4))
    return {
        "means": rng.normal(size=(num, 3)) * [1, 5, 0.1],
        "scales": rng.normal(size=(num, 3)) - 3,
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "colors": rng.uniform(-0.3, 1.4, (num, 3)),
        "opacities": rng.uniform(0.02, 0.98, num),
        "sh": rng.uniform(-3.5, 3.5, (num, 9)),
    }


def together(codes: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """One unsigned integer of columns of codes, the first highest."""
    packed = np.zeros(len(codes), np.uint64)
    for column, num in zip(codes.T, bits, strict=True):
        packed = (packed << np.uint64(num)) | column.astype(np.uint64)
    return packed.astype("<u4")


def packed_file(path, rows, *, has_colors: bool = True, has_sh: bool = True, changes: dict | None = None):
    """A file of the rows; `changes` replaces text of its header."""
    num = len(rows["means"])
    chunks = [slice(start, start + 256) for start in range(0, num, 256)]
    groups = ["means", "scales", *(["colors"] if has_colors else [])]
    bounds = [[end(rows[name][chunk], axis=0) for name in groups for end in (np.min, np.max)] for chunk in chunks]

    def codes(name: str, bits: tuple[int, ...]) -> np.ndarray:
        shares = np.concatenate(
            [(rows[name][chunk] - rows[name][chunk].min(0)) / np.ptp(rows[name][chunk], axis=0) for chunk in chunks]
        )
        return np.rint(shares * (2.0 ** np.array(bits) - 1))

    colors = codes("colors", (8, 8, 8)) if has_colors else np.rint(np.clip(rows["colors"], 0, 1) * 255)
    vertex = np.stack(
        [
            together(codes("means", (11, 10, 11)), (11, 10, 11)),
            packed_rotations(rows["quats"]),
            together(codes("scales", (11, 10, 11)), (11, 10, 11)),
            together(np.column_stack([colors, np.rint(rows["opacities"] * 255)]), (8, 8, 8, 8)),
        ],
        axis=1,
    )
    names = [*BOUNDS, *(COLOR_BOUNDS if has_colors else [])]
    header = ["ply", "format binary_little_endian 1.0", "comment by hand", f"element chunk {len(chunks)}"]
    header += [f"property float {name}" for name in names] + [f"element vertex {num}"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    body = np.array(bounds, "<f4").tobytes() + vertex.astype("<u4").tobytes()
    if has_sh:
        header += [f"element sh {num}", *(f"property uchar f_rest_{k}" for k in range(rows["sh"].shape[1]))]
        body += np.clip(np.trunc((rows["sh"] / 8 + 0.5) * 256), 0, 255).astype(np.uint8).tobytes()
    text = "\n".join([*header, "end_header\n"])
    for old, new in (changes or {}).items():
        assert old in text
        text = text.replace(old, new)
    path.write_bytes(text.encode() + body)
    return path


def packed_rotations(quats: np.ndarray) -> np.ndarray:
    """One row after the other, as the format is described."""
    packed = []
    for quat in quats:
        largest = int(np.argmax(np.abs(quat)))
        quat = -quat if quat[largest] < 0 else quat
        number = largest
        for k in range(4):
            if k != largest:
                number = number << 10 | int(np.rint((quat[k] / np.sqrt(2) + 0.5) * 1023))
        packed.append(number)
    return np.array(packed, "<u4")


def read(path) -> np.ndarray:
    with open(path, "rb") as file:
        return unpacked_vertices(PlyFile(file, path))


def columns(vertices: np.ndarray, pattern: str, num: int) -> np.ndarray:
    return np.stack([vertices[pattern.format(k)] for k in range(num)], axis=1).astype(np.float64)


@pytest.mark.parametrize("has_colors", [True, False])
def test_numbers_come_back_within_half_a_step(tmp_path, has_colors):
    rows = some_rows()
    found = read(packed_file(tmp_path / "a.ply", rows, has_colors=has_colors))
    for name, values in (
        ("means", np.stack([found[axis] for axis in "xyz"], axis=1)),
        ("scales", columns(found, "scale_{}", 3)),
    ):
        step = np.ptp(rows[name], axis=0) / [2047, 1023, 2047]
        assert np.all(np.abs(values - rows[name]) <= step / 2 + 1e-5)
    quats = columns(found, "rot_{}", 4)
    assert np.abs(np.sum(quats * rows["quats"], axis=1)).min() > 1 - 1e-5
    colors = 0.5 + SH_C0 * columns(found, "f_dc_{}", 3)
    wanted = rows["colors"] if has_colors else np.clip(rows["colors"], 0, 1)
    assert np.abs(colors - wanted).max() <= 1.7 / 255 / 2 + 1e-5
    assert np.abs(1 / (1 + np.exp(-found["opacity"])) - rows["opacities"]).max() <= 0.5 / 255 + 1e-5
    assert np.abs(columns(found, "f_rest_{}", 9) - rows["sh"]).max() <= 8 / 256 / 2 + 1e-6


def test_they_are_gaussians_like_others(tmp_path):
    with pytest.warns(UserWarning, match="thinnest axis"):
        gaussians = load_ply(packed_file(tmp_path / "a.ply", some_rows()))
    assert gaussians.num == NUM and gaussians.sh_degree == 1
    with pytest.warns(UserWarning, match="thinnest axis"):
        assert load_ply(packed_file(tmp_path / "b.ply", some_rows(), has_sh=False)).sh_degree == 0


def test_degree_4_is_read_to_degree_3(tmp_path):
    rows = some_rows() | {"sh": np.random.default_rng(6).uniform(-3.5, 3.5, (NUM, 72))}
    path = packed_file(tmp_path / "a.ply", rows)
    with pytest.warns(UserWarning, match="thinnest axis"), pytest.warns(UserWarning, match="has SH of degree 4"):
        sh = np.asarray(load_ply(path).sh)
    wanted = rows["sh"].reshape(NUM, 3, 24)[:, :, :15].transpose(0, 2, 1)
    assert np.abs(sh[:, 1:] - wanted).max() <= 8 / 256 / 2 + 1e-6


def test_opacities_of_nothing_and_all_are_finite(tmp_path):
    rows = some_rows() | {"opacities": np.repeat([0.0, 1.0], NUM // 2)}
    opacity = read(packed_file(tmp_path / "a.ply", rows))["opacity"]
    assert np.isfinite(opacity).all() and opacity[0] < -10 and opacity[-1] > 10


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"element chunk 2": "element chunk 3"}, "3 chunks for 300 vertices"),
        ({"element vertex 300": "element vertex 400"}, "sh must be uchar"),
        ({"element vertex 300": "element vertex 99999999999"}, "chunks for"),
        ({"element vertex 300": "element vertex x"}, "a number is expected"),
        ({"element sh 300": "element more 300"}, "has the elements chunk, vertex and sh"),
        ({"float min_x": "float other_x"}, "has no attribute min_x"),
        ({"uint packed_scale": "float packed_scale"}, "must be uint"),
        ({"uchar f_rest_3": "ushort f_rest_3"}, "sh must be uchar"),
        ({"uint packed_color": "list uchar int packed_color"}, "cannot read the vertex property"),
        ({"binary_little_endian": "binary_big_endian"}, "binary_little_endian is expected"),
        ({"binary_little_endian": "middle"}, "is a PLY in middle"),
    ],
)
def test_files_that_contradict_themselves_are_refused(tmp_path, changes, match):
    path = packed_file(tmp_path / "bad.ply", some_rows(), changes=changes)
    with pytest.raises(ValueError, match=rf"bad\.ply: .*{match}"):
        load_ply(path)


def test_files_that_are_cut_off_are_refused(tmp_path):
    data = packed_file(tmp_path / "a.ply", some_rows()).read_bytes()
    for length in (40, len(data) // 3, len(data) // 2, len(data) - 1):
        (tmp_path / "bad.ply").write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"bad\.ply"):
            load_ply(tmp_path / "bad.ply")
