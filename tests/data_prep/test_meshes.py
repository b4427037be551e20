"""Meshes: what OBJ and PLY files hold, hostile files, and the surface that is made of them."""

import struct
from pathlib import Path

import numpy as np
import pytest

from data_prep.blender.meshes import Mesh, make_surface, read_mesh, refine
from gausim.core import DataError

CORNERS = [(x, y, z) for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TETRAHEDRON = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
POINTS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.2, 0.3, 1)], np.float64)


def box_obj(path: Path) -> Path:
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS]
    lines += ["f " + " ".join(f"{i + 1}/1/{i + 1}" for i in quad) for quad in QUADS]
    path.write_text("# a box\nvt 0 0\n" + "\n".join(lines) + "\n")
    return path


def ply(
    path: Path, encoding: str, faces: list[tuple[int, ...]], *, count: str | None = None, kind: str = "int"
) -> Path:
    header = f"ply\nformat {encoding} 1.0\ncomment made here\nelement vertex {count or len(CORNERS)}\n"
    header += "property float x\nproperty float y\nproperty double z\nproperty uchar red\n"
    header += f"element face {len(faces)}\nproperty uchar quality\nproperty list uchar {kind} vertex_indices\n"
    header += "end_header\n"
    if encoding == "ascii":
        lines = [f"{x} {y} {z} 255" for x, y, z in CORNERS]
        lines += [f"7 {len(face)} " + " ".join(map(str, face)) for face in faces]
        path.write_text(header + "\n".join(lines) + "\n")
        return path
    order = "<" if "little" in encoding else ">"
    body = b"".join(struct.pack(f"{order}ffdB", *corner, 255) for corner in CORNERS)
    body += b"".join(struct.pack(f"{order}BB{len(face)}i", 7, len(face), *face) for face in faces)
    path.write_bytes(header.encode() + body)
    return path


def volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = vertices[triangles.T]
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_obj_and_all_encodings_of_ply_give_the_same_box(tmp_path: Path) -> None:
    expected = read_mesh(box_obj(tmp_path / "box.obj"))
    assert expected.vertices.tolist() == [list(c) for c in CORNERS] and expected.triangles.shape == (12, 3)
    for encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        found = read_mesh(ply(tmp_path / f"{encoding}.ply", encoding, QUADS))
        np.testing.assert_array_equal(found.vertices, expected.vertices)
        np.testing.assert_array_equal(found.triangles, expected.triangles)


@pytest.mark.parametrize(
    "text", ["v 0 0\n", "v 0 0 x\n", "v 0 0 0\nf 1 a 1\n", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n",
             "v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "v 0 0 0\n", ""],
)  # fmt: skip
def test_damaged_obj(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bad.obj"
    path.write_text(text)
    with pytest.raises(DataError, match=r"bad\.obj: "):
        read_mesh(path)


def test_damaged_ply_and_useless_surfaces_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, encoding = tmp_path / "bad.ply", "binary_little_endian"
    with pytest.raises(DataError, match=r"bad\.ply: .*not there"):
        read_mesh(ply(path, encoding, [(0, 1, 8)]))
    whole = ply(path, encoding, QUADS).read_bytes()
    for length in range(0, len(whole) - 2, 37):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"bad\.ply: "):
            read_mesh(path)
    path = tmp_path / "m.obj"
    flat = Mesh(POINTS * (1, 1, 0), np.array(TETRAHEDRON))
    with pytest.raises(DataError, match="flat along its up axis 'z'"):
        make_surface(flat, path, up="z", points=4, seed=0)
    for vertices in (POINTS * 0, POINTS * (1, 0, 0)):
        with pytest.raises(DataError, match="no face has an area"):
            make_surface(Mesh(vertices, np.array(TETRAHEDRON)), path, up="z", points=4, seed=0)
    with pytest.raises(DataError, match="too large"):
        make_surface(Mesh((POINTS - 0.5) * 3e308, np.array(TETRAHEDRON)), path, up="z", points=4, seed=0)
    monkeypatch.setattr("data_prep.blender.meshes.MOST_TRIANGLES", 5000)
    with pytest.raises(DataError, match="Remesh"):
        refine(Mesh(POINTS, np.array(TETRAHEDRON)), 1e-4)


def test_surface_stands_upright_in_its_frame(tmp_path: Path) -> None:
    path = box_obj(tmp_path / "box.obj")
    for up, extent in (("x", (4 / 3, 2, 2 / 3)), ("y", (2, 2 / 3, 4 / 3)), ("z", (2 / 3, 4 / 3, 2))):
        found = make_surface(read_mesh(path), path, up=up, points=50, seed=0)
        np.testing.assert_allclose(np.ptp(found.vertices, axis=0), extent, rtol=1e-6)
        np.testing.assert_allclose(found.vertices[:, :2].min(0), -found.vertices[:, :2].max(0), rtol=1e-6)
        assert found.vertices[:, 2].min() == 0 and len(found.gt_ids) == 50
        # Outward faces stay outward: the object is turned, not mirrored.
        original = read_mesh(path)
        turned = volume(found.vertices.astype(np.float64), found.faces)
        assert np.sign(turned) == np.sign(volume(original.vertices, original.triangles))


def test_refined_surface_is_closed_and_of_the_same_volume_and_area() -> None:
    mesh = Mesh(POINTS, np.array(TETRAHEDRON))
    fine = refine(mesh, 0.13)
    for found in (mesh, fine):
        np.testing.assert_allclose(volume(found.vertices, found.triangles), 1 / 6, rtol=1e-12)
        edges = np.concatenate([found.triangles[:, [i, (i + 1) % 3]] for i in range(3)])
        assert len(np.unique(edges, axis=0)) == len(edges)  # each directed edge once, so neighbours stay joined
        assert {tuple(e) for e in edges.tolist()} == {tuple(e[::-1]) for e in edges.tolist()}
    lengths = np.linalg.norm(np.diff(fine.vertices[edges], axis=1)[:, 0], axis=1)
    assert lengths.max() <= 0.13 and len(fine.triangles) > 100
