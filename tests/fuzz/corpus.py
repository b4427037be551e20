"""The readers of the product that take files from anywhere, and a small good file for each."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import plyfile
import torch
from helpers import colmap_files, public_sets, toy_object
from helpers.corpus import write_corpus

from data_prep.blender.meshes import read_mesh
from data_prep.capture.cameras.sources import read_lens_transforms, read_projections
from data_prep.capture.films.film import pictures, probe, upright
from data_prep.capture.films.takes import find_takes
from data_prep.capture.masks.clips import read_picture
from data_prep.common.photos import open_photo, read_photo
from data_prep.common.stage import read_manifest
from data_prep.dataset import plan
from data_prep.import_3dgsim import GenesisOptions, read_3dgsim
from data_prep.import_pacnerf import PacNerfOptions, read_pacnerf
from data_prep.import_physdreamer import PhysDreamerOptions, read_capture
from data_prep.import_phystwin import PhysTwinOptions, read_phystwin
from data_prep.import_ready import ReadyOptions, import_ready
from data_prep.import_springgaus import SpringGausOptions, read_real, read_synthetic
from data_prep.pack import pack
from data_prep.public.pickles import read_pickle
from data_prep.ready.authors import read_pins
from data_prep.ready.gathered import gather
from data_prep.ready.selections import read_points
from gausim.core.errors import GausSimError
from gausim.data.corpus import Corpus
from gausim.data.images import read_rgba, write_rgba
from gausim.data.objects import ObjectData
from gausim.data.records import read_stills
from gausim.data.verify import verify
from gausim.interaction.selections import Ball, Kernels
from gausim.interaction.session import Entry, Force, ForceSession, MadeWith, Pin, Reset, load_session, save_session
from gausim.io.colmap import read_colmap
from gausim.io.motion import load_motion, motion_glb
from gausim.io.npz import read_array
from gausim.io.plain_json import read_json
from gausim.io.ply import load_masks, load_scene, save_scene
from gausim.io.ply_sequence import load_ply_sequence, save_ply_sequence
from gausim.io.trajectory import load_trajectory, save_trajectory
from gausim.io.transforms import read_transforms, write_transforms
from gausim.io.video import read_video, video_rate, write_video
from gausim.results.summary import SCHEMA, load_summary
from gausim.runs.directory import RunDirectory

TESTS = Path(__file__).parents[1]
SCENE = toy_object.toy_scene()

_MADE = MadeWith("toy", "0" * 64, "1" * 64, "2" * 64)
_PUSH = Force(on=Ball((0.0, 0.0, 1.0), 0.2), direction=(1.0, 0.0, 0.0), weights=2.0, frames=3)
SESSION = ForceSession(_MADE, 24.0, 8, (Entry(1, _PUSH), Entry(4, Pin(Kernels((1, 2)))), Entry(6, Reset())), 9.81)


@dataclass(frozen=True)
class Reader:
    """One way to read a file."""

    name: str  # what it is called
    file: Path  # the file that is damaged
    kind: str  # how, see :func:`mutations.mutated`
    read: Callable[[Path], Any]  # reads it (and what it needs beside it); what it returns has to be finite
    weight: int = 4  # damaged files in proportion to the others'


def readers(folder: Path) -> list[Reader]:
    """Writes the good files into ``folder`` and lists who reads them."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    made = (_scenes, _object, _store, _posed, _colmap, _ready, _public, _images, _films, _settings)
    return [reader for make in made for reader in make(folder)]


def _scenes(folder: Path) -> Iterator[Reader]:
    toy = toy_object.ToyObject(folder / "scene", SCENE)
    (folder / "scene").mkdir()
    path = folder / "scene" / "scene.ply"
    save_scene(SCENE, path)
    yield Reader("scene", path, "text", load_scene, 8)
    text = folder / "scene_text" / "scene.ply"
    save_scene(replace(SCENE, name="text"), text)
    plyfile.PlyData(plyfile.PlyData.read(path).elements, text=True).write(text)
    yield Reader("scene, text", text, "text", load_scene)
    yield Reader("points", text, "text", read_points)
    mesh = folder / "mesh.ply"
    mesh.write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        b"element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        b"0 0 0\n1 0 0\n1 1 0\n0 1 1\n4 0 1 2 3\n3 0 2 3\n"
    )
    yield Reader("mesh", mesh, "text", lambda p: vars(read_mesh(p)))
    yield Reader("masks", path.with_name("scene.masks.npz"), "npz", lambda p: load_masks(SCENE, p))
    save_trajectory(folder / "scene" / "t.safetensors", toy.truth("seq_000", 3), facts={"object": "toy"})
    yield Reader("trajectory", folder / "scene" / "t.safetensors", "binary", load_trajectory, 8)
    yield from _motions(folder / "scene", toy)
    save_session(SESSION, folder / "scene" / "pull.json")
    yield Reader("session of forces", folder / "scene" / "pull.json", "json", load_session, 6)
    frames = save_ply_sequence(folder / "frames", "toy", [SCENE, SCENE], 24.0)
    yield Reader("PLY sequence", frames[1], "binary", lambda p: list(load_ply_sequence(p.parent)[0]))
    yield Reader(
        "rate of a PLY sequence", folder / "frames" / "toy.json", "json", lambda p: load_ply_sequence(p.parent)
    )


def _motions(folder: Path, toy: toy_object.ToyObject) -> Iterator[Reader]:
    motion = motion_glb(SCENE, toy.truth("seq_000", 3))
    path, facts = folder / "t.motion.glb", folder / "t.json"
    path.write_bytes(motion.to_bytes())
    facts.write_text(json.dumps(motion.document))

    def packed(p: Path) -> Any:
        """The damaged JSON part between a header that fits it and the good binary part."""
        text, whole = p.read_bytes(), p.with_name("u.motion.glb")
        lengths = struct.pack("<III", 2, 28 + len(text) + len(motion.binary), len(text))
        head = b"glTF" + lengths + b"JSON" + text + struct.pack("<I", len(motion.binary))
        whole.write_bytes(head + b"BIN\0" + motion.binary)
        return load_motion(whole)

    yield Reader("motion", path, "binary", load_motion, 6)
    yield Reader("facts of a motion", facts, "json", packed, 6)


def _object(folder: Path) -> Iterator[Reader]:
    toy = toy_object.write_toy_object(folder / "object", frames=8)
    root, sequence = toy.root, toy.root / "sequences" / "seq_000"

    def whole(_: Path) -> Any:
        data = ObjectData(root)
        record = data.sequences[0]
        return data.facts, record.cameras, record.frames(range(1)), data.ground_truth(record), data.rest_points

    yield Reader("dataset.json", root / "dataset.json", "json", whole, 6)
    yield Reader("transforms of a sequence", sequence / "transforms.json", "json", whole, 6)
    yield Reader("ground truth", sequence / "ground_truth.npz", "npz", whole)
    yield Reader("rest points", root / "rest_points.npz", "npz", whole)
    yield Reader("array", root / "rest_points.npz", "npz", lambda p: read_array(p, "points"), 2)
    yield Reader("frame", sequence / "cam_0" / "0000.png", "png", whole)
    yield Reader("any json", root / "dataset.json", "json", read_json, 2)
    yield from _surroundings(folder)
    bodies = write_corpus(folder / "bodies", bodies=1)

    def body(_: Path) -> Any:
        found = Corpus(bodies).body(0)
        return found.rest, found.stiffness, found.positions

    yield Reader("manifest of a corpus", bodies / "manifest.json", "json", body)
    yield Reader("shard of a corpus", bodies / "shard_00000.safetensors", "binary", body)


def _surroundings(folder: Path) -> Iterator[Reader]:
    root = toy_object.write_toy_object(folder / "held", frames=8).root
    floor = {"point": [0.0, 0.0, -1.0], "normal": [0.0, 0.0, 1.0], "friction": 0.3, "restitution": 0.1}
    toy_object.surround(root, gravity=[0.0, 0.0, -9.8], floor=floor, free=False)
    toy_object.hold(root, SCENE.means[SCENE.pinned][:4], torch.zeros(8, 3))

    def held(_: Path) -> Any:
        data = ObjectData(root)
        hands = [record.hands.pose(3) for record in data.sequences if record.hands is not None]
        scene, world = data.scene(), data.surroundings
        assert world.floor is None or scene.surroundings == world
        return world.gravity, world.floor and world.floor.normal, [(h.rotations, h.centres) for h in hands]

    yield Reader("surroundings", root / "dataset.json", "json", held, 6)
    yield Reader("hands", root / "sequences" / "seq_000" / "hands.npz", "npz", held, 6)


def _store(folder: Path) -> Iterator[Reader]:
    root = toy_object.write_toy_object(folder / "packing", frames=8).root
    pack(root, folder / "store")
    place = folder / "store" / "sequences" / "seq_001"

    def frames(_: Path) -> Any:
        record = ObjectData(folder / "store").sequences[1]
        return record.cameras, record.frames(range(record.count))

    def verified(path: Path) -> Any:
        """Names faults instead of raising: the manifest and what it lists cannot be damaged unnoticed."""
        faults = verify(folder / "store", quick=False)
        if faults:
            raise GausSimError(f"{folder}: " + "; ".join(f"{fault.where}: {fault.what}" for fault in faults))

    yield Reader("packed header", place / "frames.json", "json", frames, 8)
    yield Reader("packed pixels", place / "frames.bin", "binary", verified, 1)
    yield Reader("store's manifest", folder / "store" / "stage.json", "json", lambda p: read_manifest(p.parent), 2)
    yield Reader("verify", folder / "store" / "stage.json", "json", verified, 1)


def _posed(folder: Path) -> Iterator[Reader]:
    root = folder / "posed"
    (root / "images").mkdir(parents=True)
    views = toy_object.cameras()
    pixels = toy_object.rgba(SCENE, toy_object.ToyObject(root, SCENE).truth("seq_000", 1))[0]
    for name, image in zip(views.names, pixels, strict=True):
        write_rgba(root / "images" / f"{name}.png", image)
    path = root / "transforms.json"
    write_transforms(path, views, [{"file_path": f"images/{name}.png"} for name in views.names])
    yield Reader("stills", path, "json", lambda p: (read_transforms(p), read_stills(p)), 6)
    yield Reader("lenses", path, "json", read_lens_transforms)
    yield Reader("assembled", path, "json", lambda p: gather([p.parent]), 2)
    matrices = root / "matrices"
    matrices.mkdir()
    for name, viewmat, k in zip(views.names, views.viewmats, views.Ks, strict=True):
        np.savetxt(matrices / f"{name}_P.txt", (k @ viewmat[:3]).numpy())
    first = matrices / f"{views.names[0]}_P.txt"
    yield Reader("projection", first, "text", lambda p: read_projections(p.parent, root / "images", 1.0))


def _colmap(folder: Path) -> Iterator[Reader]:
    for suffix in ("binary", "text"):
        place = folder / f"colmap_{suffix}"
        getattr(colmap_files, f"write_{suffix}")(place, *colmap_files.small_model())
        for path in sorted(place.iterdir()):
            yield Reader(f"colmap {path.name}", path, suffix, lambda p: read_colmap(p.parent), 6)


def _ready(folder: Path) -> Iterator[Reader]:
    root, size = folder / "ready", (32, 24)
    names = ["still.png", "seq_00001_cam_00000.png", "seq_00001_cam_00001.png"]
    images = {i: (name, 1, *colmap_files.turntable(0.5 * i), []) for i, name in enumerate(names)}
    cameras = {1: ("PINHOLE", *size, [60.0, 60.0, 16.0, 12.0])}
    colmap_files.write_binary(root / "sparse" / "0", cameras, images, colmap_files.small_model()[2])
    for name in names:
        _picture(root / "images" / name, size)
    for camera in ("cam_00000", "cam_00001"):
        for frame in range(2):
            _picture(root / "video_images" / f"seq_00001_{camera}" / f"{frame:05d}.png", size)
    (root / "meta.json").write_text(
        json.dumps({"train": ["seq_00001"], "test": [], "invalid": [], "force_invalid": []})
    )
    pins = folder / "pin_mask.json"
    pins.write_text(json.dumps([0, 3, 5]))
    out = folder / "ready_out"

    def imported(_: Path) -> Any:
        try:
            return import_ready(root, out, ReadyOptions(train_frames=2))["results"]
        finally:
            for path in (out, out.with_name(f".{out.name}.import_ready.work")):
                shutil.rmtree(path, ignore_errors=True)

    yield Reader("meta.json", root / "meta.json", "json", imported, 1)
    yield Reader("pin_mask.json", pins, "json", lambda p: read_pins(p, 36))


def _public(folder: Path) -> Iterator[Reader]:
    """The public sets: what their importers read before they write."""
    root = folder / "public"
    public_sets.write_springgaus(root / "torus")
    public_sets.write_springgaus_real(root / "real", stills=3)
    public_sets.write_pacnerf(root / "bird")
    public_sets.write_phystwin(root / "different_types" / "sloth")
    public_sets.write_3dgsim(root / "genesis")
    hat = public_sets.write_physdreamer(root / "hat")
    entries = [{"file_path": f"images/frame_0000{i + 1}.png"} for i in range(3)]
    write_transforms(root / "hat" / "transforms_train.json", hat.views, entries)
    real, phystwin = SpringGausOptions(object="bun"), PhysTwinOptions()
    sets: dict[str, tuple[Callable[[], Any], tuple[str, ...]]] = {
        "torus": (lambda: [read_synthetic(root / "torus", SpringGausOptions())], ("camera.json", "frame.json")),
        "real": (lambda: [read_real(root / "real", real)],
                 ("dynamic/cameras_calib.json", "dynamic/sequences/bun/0.json", "static/colmap/bun/cameras.bin")),
        "bird": (lambda: [read_pacnerf(root / "bird", PacNerfOptions())], ("all_data.json",)),
        "different_types/sloth": (lambda: [read_phystwin(root / "different_types" / "sloth", phystwin)],
                  ("metadata.json", "split.json", "mask/mask_info_1.json", "calibrate.pkl", "final_data.pkl",
                   "gt_track_3d.pkl")),
        "genesis": (lambda: read_3dgsim(root / "genesis", GenesisOptions(fps=25)), ("0001/metadata.json",)),
    }  # fmt: skip
    kinds = {".json": "json", ".pkl": "binary", ".bin": "binary"}
    for name, (read, files) in sets.items():
        for file in files:
            path = root / name / file
            yield Reader(f"{name}: {path.name}", path, kinds[path.suffix], partial(_of_public, read), 2)
    yield Reader("pickle", root / "different_types" / "sloth" / "final_data.pkl", "binary", _pickled, 6)
    yield Reader("stills of PhysDreamer", root / "hat" / "transforms_train.json", "json", _stills_of_physdreamer, 2)
    segments = root / "genesis" / "0001" / "cam_0" / "seg_0000.png"
    shown = read_3dgsim(root / "genesis", GenesisOptions(fps=25))[0].motions[0].pictures["cam_0"][0]
    yield Reader("segments", segments, "png", lambda p: shown.read())


def _of_public(read: Callable[[], Any], _: Path) -> Any:
    """The numbers that an importer takes over."""
    found = [one.checked() for one in read()]
    views = [(view.k, view.viewmat) for one in found for motion in one.motions for view in motion.views]
    hands = [motion.hands.points for one in found for motion in one.motions if motion.hands is not None]
    tracks = [motion.tracks for one in found for motion in one.motions if motion.tracks is not None]
    return [(one.fps, one.train_frames, dict(one.world)) for one in found], views, hands, tracks


def _stills_of_physdreamer(path: Path) -> Any:
    return [shot.viewmat for shot in read_capture(path.parent, PhysDreamerOptions()).posed.values()]


def _pickled(path: Path) -> int:
    """Reads plain data, in which NaN is allowed."""
    read_pickle(path)
    return 1


def _picture(path: Path, size: tuple[int, int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.arange(size[1] * size[0] * 3).reshape(size[1], size[0], 3) % 251
    cv2.imwrite(str(path), rows.astype(np.uint8))


def _images(folder: Path) -> Iterator[Reader]:
    place = folder / "images"
    rgba = np.random.default_rng(0).integers(0, 255, (24, 32, 4)).astype(np.uint8)
    for suffix in ("png", "jpg", "tif", "bmp", "webp"):
        path = place / f"p.{suffix}"
        _picture(path, (32, 24))
        kind = "png" if suffix == "png" else "binary"
        yield Reader(f"photo {suffix}", path, kind, lambda p: read_photo(open_photo(p, p.name)))
        yield Reader(f"picture {suffix}", path, kind, read_picture)
    cv2.imwrite(str(place / "rgba.png"), rgba)
    yield Reader("rgba", place / "rgba.png", "png", lambda p: read_rgba(p, (32, 24)), 8)


def _films(folder: Path) -> Iterator[Reader]:
    place = folder / "films"
    place.mkdir()
    for suffix in ("mp4", "mkv"):
        path = place / f"film.{suffix}"
        write_video(path, [np.full((24, 32, 3), 40 * k, np.uint8) for k in range(5)], 25)

        def ingested(p: Path) -> Any:
            found = probe(p)
            return found, [upright(found, frame) for _, frame in pictures(found)]

        yield Reader(f"film {suffix}", path, "binary", ingested, 2)
        yield Reader(f"video {suffix}", path, "binary", lambda p: (video_rate(p), list(read_video(p))), 2)
    takes = place / "takes.json"
    cameras = {"left": "film.mp4", "right": "film.mkv"}
    take = {"name": "poke", "cameras": cameras, "offsets": {"right": "7.3f"}, "start": 0.5, "duration": 2.0}
    takes.write_text(json.dumps({"sequences": [take]}))
    yield Reader("list of films", takes, "json", find_takes)


def _settings(folder: Path) -> Iterator[Reader]:
    place = folder / "settings"
    place.mkdir()
    config = place / "object.yaml"
    config.write_text(
        "work: work\nstages:\n  ingest: {films: takes, sync: auto, start: 1.5}\n"
        '  segment-films: {pictures: "{ingest}/sequences", no_grabcut: true}\n  pack: {root: [a, 2]}\n'
    )
    yield Reader("stages", config, "text", plan)
    run = place / "config.yaml"
    run.write_text("name: demo\nseed: 0\nmodel:\n  simulator: {_target_: gausim.X, layers: 2}\n  list: [1, 2.5]\n")
    yield Reader("run's configuration", run, "text", lambda p: str(RunDirectory(p.parent).config()))
    rows = {"ours": {"seen": {"train": {"psnr": {"mean": 30.5, "ratio": None}}}}}
    metrics = {"psnr": {"label": "PSNR", "scale": 1.0, "unit": "dB", "higher_is_better": True}}
    toy = {"sequences": ["a"], "splits": {"seen": [0, 2]}, "metrics": metrics, "rows": rows, "methods": ["ours"]}
    summary = place / "metrics.json"
    summary.write_text(json.dumps({"objects": {"toy": toy}, "run": {}, "schema": SCHEMA}))
    yield Reader("summary", summary, "json", lambda p: str(load_summary(p)), 2)
