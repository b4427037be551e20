"""3DGS PLY files: what is written is read back bit by bit, and every malformed file is refused by name."""

import re
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from helpers.plain import FIELDS, random_scene

from gausim.core.errors import SceneError
from gausim.core.scene import GaussianScene
from gausim.io.ply import OTHER_FORMATS, load_masks, load_scene, save_masks, save_scene


def columns_of(scene: GaussianScene) -> dict[str, np.ndarray]:
    """An independent statement of the INRIA layout."""
    columns = {n: scene.means[:, i].numpy() for i, n in enumerate("xyz")}
    columns |= {f"f_dc_{i}": scene.sh[:, 0, i].numpy() for i in range(3)}
    per_channel = scene.sh.shape[1] - 1
    for channel in range(3):
        for b in range(per_channel):
            columns[f"f_rest_{channel * per_channel + b}"] = scene.sh[:, 1 + b, channel].numpy()
    columns["opacity"] = scene.opacity_logits.numpy()
    columns |= {f"scale_{i}": scene.log_scales[:, i].numpy() for i in range(3)}
    return columns | {f"rot_{i}": scene.quats[:, i].numpy() for i in range(4)}


def write_ply(path: Path, columns: dict[str, np.ndarray], kind: str = "f4", **layout: object) -> None:
    """Writes vertices, and a camera with a list behind them."""
    table = np.empty(len(columns["x"]), dtype=[(n, kind) for n in columns])
    for n, value in columns.items():
        table[n] = value
    views = np.array([(np.arange(3),)], dtype=[("view", object)])
    camera = plyfile.PlyElement.describe(views, "camera", len_types={"view": "u1"}, val_types={"view": "i4"})
    vertices = plyfile.PlyElement.describe(table, "vertex", comments=["by hand"])
    plyfile.PlyData([vertices, camera], **layout).write(path)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip_is_bitwise(tmp_path: Path, degree: int) -> None:
    scene = random_scene(degree=degree)
    save_scene(scene, tmp_path / "scene.ply")
    back = load_scene(tmp_path / "scene.ply")
    assert back.sh_degree == degree
    for field in FIELDS:
        assert torch.equal(getattr(back, field), getattr(scene, field)), field
    assert back.volume_scale == 37.5
    assert back.name == "scene"
    save_scene(back, tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "scene.ply").read_bytes()
    names = {"again.masks.npz", "again.ply", "scene.masks.npz", "scene.ply"}
    assert {p.name for p in tmp_path.iterdir()} == names


def test_plyfile_reads_what_is_written(tmp_path: Path) -> None:
    scene = random_scene(degree=3)
    save_scene(scene, tmp_path / "scene.ply")
    vertex = plyfile.PlyData.read(str(tmp_path / "scene.ply"))["vertex"]
    expected = columns_of(scene)
    names = [p.name for p in vertex.properties]
    assert names[:6] == ["x", "y", "z", "nx", "ny", "nz"] and set(names) == {*expected, "nx", "ny", "nz"}
    for name, value in expected.items():
        assert np.array_equal(vertex[name], value), name


@pytest.mark.parametrize(
    ("kind", "layout"), [("f4", {}), ("f8", {}), ("f4", {"byte_order": ">"}), ("f4", {"text": True})]
)
def test_other_layouts_are_read(tmp_path: Path, kind: str, layout: dict[str, object]) -> None:
    scene = random_scene(degree=2)
    columns = columns_of(scene)
    shuffled = {n: columns[n] for n in sorted(columns, reverse=True)} | {"confidence": np.ones(scene.count)}
    write_ply(tmp_path / "other.ply", shuffled, kind, **layout)
    back = load_scene(tmp_path / "other.ply", name="other name")
    assert back.name == "other name"
    for field in ("means", "log_scales", "quats", "opacity_logits", "sh"):
        assert torch.equal(getattr(back, field), getattr(scene, field)), field
    assert back.simulated.all() and back.foreground.all() and not back.pinned.any()


def test_text_and_compressed_ply_that_are_damaged_are_refused(tmp_path: Path) -> None:
    save_scene(random_scene(), tmp_path / "good.ply", masks=False)
    plyfile.PlyData(plyfile.PlyData.read(tmp_path / "good.ply").elements, text=True).write(tmp_path / "text.ply")
    header, _, body = (tmp_path / "text.ply").read_text().partition("end_header\n")
    rows = body.splitlines()
    for changed in (rows[:-1], ["1 2"] * 7, ["x", *rows[1:]], [*rows[:-1], "x y"]):
        (tmp_path / "bad.ply").write_text(header + "end_header\n" + "\n".join(changed) + "\n")
        refuse(tmp_path / "bad.ply", "cannot be read")
    write_compressed(tmp_path / "a.ply", 300, chunks=1)
    with pytest.raises(SceneError, match="has 1 chunks; expected 2 chunks for 300 Gaussians"):
        load_scene(tmp_path / "a.ply")


def refuse(path: Path, *needles: str) -> None:
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    for needle in (path.name, *needles):
        assert needle in str(caught.value)


@pytest.mark.parametrize("change", [lambda d: d[:-1], lambda d: d[:60], lambda d: d + b"\0" * 400,
                                    lambda d: d.replace(b"vertex 7", b"vertex 999999999999")])  # fmt: skip
def test_counts_that_do_not_fit_the_data_are_refused(tmp_path: Path, change) -> None:
    path = tmp_path / "scene.ply"
    save_scene(random_scene(), path)
    path.write_bytes(change(path.read_bytes()))
    refuse(path)


@pytest.mark.parametrize(("changed", "needles"), [
    *(({name: (3, bad)}, (f"property '{name}'", "vertex 3"))
      for name, bad in (("x", np.nan), ("f_rest_4", np.inf), ("opacity", -np.inf), ("rot_3", np.nan))),
    ({"y": (2, 1e300)}, ("property 'y'", "vertex 2")),  # beyond float32
    ({f"rot_{i}": (5, 0.0) for i in range(4)}, ("first: number 5", "quaternion")),
    *(({name: None}, (f"property '{name}' is missing",)) for name in ("z", "opacity")),
    ({"f_rest_8": None}, ("8 properties 'f_rest_*'",)),
])  # fmt: skip
def test_wrong_values_and_properties_are_refused(tmp_path: Path, changed: dict, needles: tuple[str, ...]) -> None:
    columns = {name: value.astype(np.float64) for name, value in columns_of(random_scene()).items()}
    for name, change in changed.items():
        if change is None:
            del columns[name]
        else:
            columns[name][change[0]] = change[1]
    write_ply(tmp_path / "bad.ply", columns, "f8")
    refuse(tmp_path / "bad.ply", *needles)


@pytest.mark.parametrize(("content", "needle"), [
    (b"solid cube\n", "'ply'"),
    (b"ply\nelement vertex 1\nproperty float x\nend_header\n0000", "format"),
    (b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n", "empty"),
    (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n0", "'x'"),
    (b"ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n0\n", "odd.ply"),
    (b"ply\nformat binary_little_endian 1.0\nelement vertex one\nproperty float x\nend_header\n0", "integer count"),
])  # fmt: skip
def test_malformed_headers_are_refused(tmp_path: Path, content: bytes, needle: str) -> None:
    (tmp_path / "odd.ply").write_bytes(content)
    refuse(tmp_path / "odd.ply", needle)


def test_malformed_masks_are_refused(tmp_path: Path) -> None:
    scene, path = random_scene(), tmp_path / "m.masks.npz"
    every = np.ones(scene.count, dtype=bool)
    good = {"simulated": every, "pinned": ~every, "foreground": every, "volume_scale": np.float64(2.0)}
    for change, needle in [
        ({"pinned": every.astype(np.int64)}, "'pinned'"),
        ({"volume_scale": np.float64(-1)}, "'volume_scale'"),
        ({"volume_scale": np.ones(2)}, "'volume_scale'"),
        ({"foreground": np.array([None] * 7, dtype=object)}, "plain arrays"),
        ({"simulated": np.ones(9, bool)}, r"m\.masks\.npz: mask 'simulated': expected bool \(7,\).*\(9,\)"),
    ]:
        np.savez(path, **(good | change))
        with pytest.raises(SceneError, match=needle):
            load_masks(scene, path)
    path.write_bytes(b"no archive")
    with pytest.raises(SceneError, match=r"m\.masks\.npz"):
        load_masks(scene, path)
    save_scene(scene, tmp_path / "scene.ply")
    with pytest.raises(SceneError, match="no such file"):
        load_scene(tmp_path / "scene.ply", masks=tmp_path / "elsewhere.masks.npz")
    refuse(tmp_path / "absent.ply", "no such file")


def test_masks_given_by_path_are_used(tmp_path: Path) -> None:
    scene = random_scene()
    write_ply(tmp_path / "scene.ply", columns_of(scene))
    save_masks(scene, tmp_path / "mine.npz")
    assert not load_scene(tmp_path / "scene.ply").pinned.any()
    assert torch.equal(load_scene(tmp_path / "scene.ply", masks=tmp_path / "mine.npz").pinned, scene.pinned)


def pack(parts: list[tuple[int, int]]) -> int:
    """Integers with their bits, the first highest."""
    value = 0
    for part, bits in parts:
        value = value << bits | part
    return value


def write_compressed(path: Path, count: int, *, sh: int = 0, colors: bool = True, chunks: int | None = None) -> None:
    """Gaussian i of a compressed PLY: fractions i/2047, 1 and 0 of a box from -1 to 3, largest component i % 4."""
    axes = [f"{end}_{kind}{a}" for kind in ("", "scale_") for end in ("min", "max") for a in "xyz"]
    rgb = [f"{end}_{c}" for end in ("min", "max") for c in "rgb"] if colors else []
    chunk = np.zeros(-(-count // 256) if chunks is None else chunks, [(n, "f4") for n in axes + rgb])
    for n in axes:
        chunk[n] = {"min_": -1, "max_": 3}[n[:4]] - (4 if "scale" in n else 0)
    for n in rgb:
        chunk[n] = {"min_": 0.2, "max_": 0.6}[n[:4]]
    vertex = np.zeros(count, [(f"packed_{n}", "u4") for n in ("position", "rotation", "scale", "color")])
    for i in range(count):
        vertex["packed_position"][i] = pack([(i, 11), (1023, 10), (0, 11)])
        vertex["packed_scale"][i] = pack([(2047, 11), (0, 10), (i, 11)])
        vertex["packed_rotation"][i] = pack([(i % 4, 2), (1023, 10), (0, 10), (512, 10)])
        vertex["packed_color"][i] = pack([(0, 8), (255, 8), (51, 8), (255 * (i % 2), 8)])
    elements = [plyfile.PlyElement.describe(chunk, "chunk"), plyfile.PlyElement.describe(vertex, "vertex")]
    if sh:
        rest = np.zeros(count, [(f"f_rest_{n}", "u1") for n in range(sh)])
        rest["f_rest_0"], rest["f_rest_1"] = 255, 191
        elements.append(plyfile.PlyElement.describe(rest, "sh"))
    plyfile.PlyData(elements, byte_order="<").write(path)


@pytest.mark.parametrize(("count", "sh", "colors"), [(4, 0, True), (300, 9, True), (7, 45, False)])
def test_compressed_ply_is_read(tmp_path: Path, count: int, sh: int, colors: bool) -> None:
    write_compressed(tmp_path / "scene.compressed.ply", count, sh=sh, colors=colors)
    scene = load_scene(tmp_path / "scene.compressed.ply")
    fractions = 4 * torch.arange(count) / 2047
    expected = torch.stack([fractions - 1, torch.full((count,), 3.0), torch.full((count,), -1.0)], 1)
    torch.testing.assert_close(scene.means, expected)
    expected = torch.stack([torch.full((count,), -1.0), torch.full((count,), -5.0), fractions - 5], 1)
    torch.testing.assert_close(scene.log_scales, expected)
    a, c = 0.5 * 2**0.5, (512 / 1023 - 0.5) * 2**0.5
    turns = [[0.0, a, -a, c], [a, 0.0, -a, c], [a, -a, 0.0, c], [a, -a, c, 0.0]]
    torch.testing.assert_close(scene.quats[:4], torch.tensor(turns))
    rgb = torch.tensor([0.2, 0.6, 0.28] if colors else [0.0, 1.0, 0.2])
    torch.testing.assert_close(scene.sh[0, 0] * 0.28209479177387814 + 0.5, rgb)
    assert torch.sigmoid(scene.opacity_logits[:2]).tolist() == pytest.approx([0.5 / 255, 1 - 0.5 / 255])
    assert scene.sh_degree == {0: 0, 9: 1, 45: 3}[sh]
    if sh:
        assert scene.sh[0, 1:3, 0].tolist() == pytest.approx([4.0, (191.5 / 256 - 0.5) * 8])


@pytest.mark.parametrize("suffix", OTHER_FORMATS)
def test_other_formats_of_splats_are_refused_with_the_way_to_convert(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"a{suffix}").write_bytes(bytes(64))
    with pytest.raises(SceneError, match=rf"is no PLY file.*splat-transform a{suffix} a\.ply"):
        load_scene(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_flat_splats_are_named(tmp_path: Path, degree: int) -> None:
    columns = columns_of(random_scene(degree=degree))
    del columns["scale_2"]
    write_ply(tmp_path / "a.ply", columns)
    with pytest.raises(SceneError, match="2DGS"):
        load_scene(tmp_path / "a.ply")


@pytest.mark.parametrize(("shift", "refused"), [(5_212_345.75, True), (-500_000.5, True), (100.0, False)])
def test_positions_that_float32_cannot_hold_are_refused(tmp_path: Path, shift: float, refused: bool) -> None:
    columns = {n: v.astype(np.float64) for n, v in columns_of(random_scene()).items()}
    columns["y"] = columns["y"] + shift
    write_ply(tmp_path / "a.ply", columns, kind="f8")
    if not refused:
        assert load_scene(tmp_path / "a.ply").count == len(columns["x"])
        return
    with pytest.raises(SceneError, match="float32 has steps of .* Subtract"):
        load_scene(tmp_path / "a.ply")


@pytest.mark.parametrize(("unit", "refused"), [(1e-6, True), (1e-4, True), (1e-2, False), (1e4, False), (1e8, True)])
def test_extents_beyond_float32_are_refused_with_the_factor(tmp_path: Path, unit: float, refused: bool) -> None:
    def write(factor: float) -> None:
        columns = {n: values.astype(np.float64) for n, values in columns_of(random_scene()).items()}
        columns |= {n: columns[n] * factor for n in "xyz"}
        columns |= {f"scale_{i}": columns[f"scale_{i}"] + np.log(factor) for i in range(3)}
        write_ply(tmp_path / "a.ply", columns)

    write(unit)
    if refused:
        with pytest.raises(SceneError, match="the scene spans .* export again") as caught:
            load_scene(tmp_path / "a.ply")
        found = re.search(r"camera positions by (\S+), add (\S+) to", str(caught.value))
        assert found is not None and np.log(float(found[1])) == pytest.approx(float(found[2]), abs=1e-4)
        write(unit * float(found[1]))
    assert load_scene(tmp_path / "a.ply").count


def test_the_reference_lists_every_kind_of_file() -> None:
    page = (Path(__file__).parents[2] / "docs/reference/data-set.md").read_text()
    table = page[page.index("## scene.ply and its masks") : page.index("## Packed stores")]
    rows = dict(line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| "))
    (others,) = (what for file, what in rows.items() if all(f"`{suffix}`" in file for suffix in OTHER_FORMATS))
    assert "refused" in others
    known = {"compressed PLY": "read", "2DGS": "refused", "point cloud": "refused", "doubles": "float32",
             "NaN": "refused", "far outside": "warning", "either byte order": "read", "normals": "read"}  # fmt: skip
    for kind, what in known.items():  # each has its test above, or in tests/core/test_scene.py
        (found,) = (text for file, text in rows.items() if kind in file)
        assert what in found, kind
