import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.plain import contents

if importlib.util.find_spec("mujoco") is None:
    pytest.skip("MuJoCo is not installed (extra 'synth')", allow_module_level=True)

from benchmarks.reference_renderer import ReferenceRenderer
from data_prep.synthesize import main
from data_prep.synthetic.bodies import BODIES, Body, bar, jelly
from data_prep.synthetic.elastic import ElasticBody
from data_prep.synthetic.embedding import cover_surface
from data_prep.synthetic.hands import held_path, random_path
from data_prep.synthetic.plan import QUICK, RECIPES, SMALL_SWING, Material, Plan
from data_prep.synthetic.pushes import Fall, fall_field, push_field, pushed_motion, random_fall, random_push
from data_prep.synthetic.rig import still_cameras, video_cameras
from data_prep.synthetic.writer import SyntheticObject
from gausim.core import ConfigError, DivergenceError
from gausim.data.datamodule import ReadyDataModule
from gausim.data.images import composite
from gausim.data.objects import ObjectData
from gausim.ops.visual_hull import project
from gausim.render.draw import draw_still

TINY = ["--quick", "--workers", "1", "--kernels", "60", "--resolution", "24", "--frames", "17"]
PUSHED = ("flower", "potted", "pudding")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synthetic") / "set"
    assert main([*TINY, "--out", str(out)]) == 0
    return out


@pytest.fixture(params=sorted(BODIES))
def body(request: pytest.FixtureRequest) -> Body:
    return BODIES[request.param]()


def test_same_seed_same_bytes_other_seed_others(made: Path, tmp_path: Path) -> None:
    assert main([*TINY, "--out", str(tmp_path / "again"), "--objects", "pudding_soft"]) == 0
    assert main([*TINY, "--out", str(tmp_path / "other"), "--objects", "pudding_soft", "--seed", "1"]) == 0
    first, again, other = (contents(p / "pudding_soft") for p in (made, tmp_path / "again", tmp_path / "other"))
    assert first == again and len(first) > 100
    motion = "sequences/seq_000/ground_truth.npz"
    assert first[motion] != other[motion] and first["scene.ply"] != other["scene.ply"]


def test_first_frame_is_the_rest_scene_as_the_oracle_draws_it(made: Path) -> None:
    """Closes the loop through PLY, cameras and PNG: a wrong axis, order or alpha anywhere breaks it."""
    for item in ReadyDataModule(made).objects:
        scene, record = item.scene(), item.sequences[0]
        drawn = draw_still(ReferenceRenderer(), scene, record.cameras).rgb
        stored, alpha = composite(record.frames(range(1)))
        assert (drawn - stored).abs().max() < 1.5 / 255
        assert 0.05 < (alpha > 0.5).float().mean() < 0.8


def test_true_motion_starts_at_rest_and_spares_the_pinned(made: Path) -> None:
    for item in ReadyDataModule(made).objects:
        scene = item.scene()
        assert 0.01 < scene.pinned.float().mean() < 0.25
        for record in item.sequences:
            truth = item.ground_truth(record)
            assert truth is not None
            assert torch.equal(truth.rest, scene.means) and torch.equal(truth.positions[0], truth.rest)
            moved = (truth.positions - truth.rest).norm(dim=-1)
            assert moved[:, scene.pinned].max() == 0
            assert 0.04 < moved.max() / scene.diagonal < 0.1
            assert moved[1, ~scene.pinned].mean() > 0.005


def test_trilinear_points_follow_an_affine_motion_exactly(body: Body) -> None:
    points, frames, _ = cover_surface(body, 40, np.random.default_rng(0))
    matrix = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, 0.1, 1.2]])
    rest = points.positions(body.nodes)
    moved = np.stack((body.nodes, body.nodes @ matrix.T + [0.1, 0.2, 0.3]))
    np.testing.assert_allclose(points.positions(moved)[1], rest @ matrix.T + [0.1, 0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(points.deformation_gradients(moved)[1], np.tile(matrix, (40, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(points.deformation_gradients(moved)[0], np.tile(np.eye(3), (40, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(frames.transpose(0, 2, 1) @ frames, np.tile(np.eye(3), (40, 1, 1)), atol=1e-9)
    assert (np.linalg.det(frames) > 0).all()


def test_videos_are_as_wide_and_high_as_asked() -> None:
    wide = video_cameras(np.zeros(3), 1.0, (96, 54), ("a", "b"))
    pixel, _ = project(torch.zeros(1, 3), wide.viewmats, wide.Ks)
    assert (wide.width, wide.height) == (96, 54) and torch.allclose(pixel, torch.tensor([48.0, 27.0]), atol=1e-4)
    assert torch.allclose(wide.Ks[0, 0, 0], video_cameras(np.zeros(3), 1.0, (54,), ("a", "b")).Ks[0, 0, 0])
    with pytest.raises(ConfigError, match="--resolution: expected WIDTH HEIGHT"):
        Plan(resolution=(1, 2, 3))


@pytest.mark.parametrize("name", PUSHED)
def test_objects_stay_in_every_image_while_they_swing(name: str) -> None:
    body = BODIES[name]()
    low, high = body.nodes.min(0), body.nodes.max(0)
    center, radius = (low + high) / 2, float(np.linalg.norm(high - low) / 2)
    names = tuple(f"cam_{i}" for i in range(5))
    swing = 0.12 * body.diagonal * np.concatenate((np.eye(3), -np.eye(3), np.zeros((1, 3))))
    swing[[2, 5]] *= 0.3  # bodies are pushed sideways
    height = (body.nodes[:, 2] - low[2]) / (high[2] - low[2])
    moving = torch.from_numpy(body.nodes + height[:, None] * swing[:, None]).float().reshape(-1, 3)
    video, still = video_cameras(center, radius, (96,), names), still_cameras(center, radius, 96, 24)
    for cameras, x in ((video, moving), (still, torch.from_numpy(body.nodes).float())):
        pixel, depth = project(x, cameras.viewmats, cameras.Ks)
        assert depth.min() > 0 and pixel.min() > 2 and pixel.max() < 94
        assert (pixel.amax(1) - pixel.amin(1)).amax(-1).min() > 48, "the object is small in the image"


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(n for n, recipe in RECIPES.items() if recipe.body in PUSHED))
def test_objects_swing_slowly_enough_to_be_filmed(name: str) -> None:
    """Amplitude 5 to 9 % of the diagonal, periods of 6 to 16 frames; half the swing is left, a quarter in a gel."""
    recipe = RECIPES[name]
    body = BODIES[recipe.body]()
    elastic = ElasticBody(body, recipe.material, fps=24, time_step=recipe.time_step, viscosity=recipe.viscosity)
    push = random_push(body, "drag", np.random.default_rng(3), SMALL_SWING)
    motion = pushed_motion(body, elastic, push, 50) - body.nodes
    peak = np.linalg.norm(motion, axis=-1).max() / body.diagonal
    assert peak == pytest.approx(push.amplitude, rel=0.15) and 0.045 < peak < 0.095
    spectrum = (np.abs(np.fft.rfft(motion - motion.mean(0), 512, axis=0)) ** 2).sum((1, 2))
    assert 6 < 512 / (1 + spectrum[1:].argmax()) < 16
    power = (np.abs(np.fft.rfft(motion, axis=0)) ** 2).sum((1, 2))
    fast = np.fft.rfftfreq(50) > 1 / 5
    assert power[fast].sum() / power[1:].sum() < 0.2
    swing = np.sqrt((motion**2).sum((1, 2)))
    left = swing[-16:].max() / swing[:16].max()
    assert 0.4 < left < 0.7 if recipe.viscosity is None else 0.2 < left < 0.35


@pytest.mark.parametrize("name", PUSHED)
def test_pokes_are_local_and_held_nodes_stay(name: str) -> None:
    body = BODIES[name]()
    push = random_push(body, "poke", np.random.default_rng(0), SMALL_SWING)
    field = np.linalg.norm(push_field(body, push), axis=1)
    distance = np.linalg.norm(body.nodes - np.array(push.point), axis=1)
    assert field[body.held].max() == 0
    assert field[distance < 0.1 * body.diagonal].min() > 3 * field[distance > 0.6 * body.diagonal].max()


def test_instability_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    body = BODIES["pudding"]()
    elastic = ElasticBody(body, Material(1e7, 0.35, 0.7), fps=24, time_step=5e-3)
    with pytest.raises(DivergenceError, match=r"left the finite numbers .* Soften the material"):
        elastic.simulate(np.where(body.held[:, None], 0.0, 1.0), 20)
    assert not list(tmp_path.iterdir()), "MuJoCo left a log file"


@pytest.mark.slow
def test_worker_processes_write_the_same_set(made: Path, tmp_path: Path) -> None:
    arguments = [a if a != "1" else "2" for a in TINY]
    assert main([*arguments, "--out", str(tmp_path / "set")]) == 0
    assert contents(tmp_path / "set") == contents(made)


FPS = 24
JELLY, BAR = RECIPES["jelly_fall"], RECIPES["bar_hands"]


def elastic(recipe=JELLY, **options) -> ElasticBody:
    settings = {"fps": FPS, "time_step": recipe.time_step, "viscosity": recipe.viscosity, **options}
    return ElasticBody(jelly() if recipe is JELLY else bar(), recipe.material, **settings)


@pytest.fixture(scope="module")
def fall() -> tuple[Fall, np.ndarray]:
    drawn, body = random_fall(np.random.default_rng(0)), jelly()
    motion = elastic(floor=JELLY.floor).simulate(fall_field(body, drawn), 26, shift=np.array(drawn.shift))
    return drawn, motion


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synthetic") / "set"
    options = ["--kernels", "100", "--resolution", "16", "--frames", "16", "--sequences", "1", "--workers", "1"]
    assert main(["--quick", "--objects", "jelly_fall,bar_hands", *options, "--out", str(out)]) == 0
    return out


def test_centre_of_mass_falls_on_the_parabola(fall: tuple[Fall, np.ndarray]) -> None:
    drawn, motion = fall
    centre = motion.mean(1)
    landed = int(np.flatnonzero(motion[..., 2].min(1) < 0.01)[0])
    assert 7 <= landed <= 12
    t = np.arange(landed) / FPS
    straight = centre[0] + np.outer(t, drawn.velocity)
    dropped = centre[:landed] - straight
    np.testing.assert_allclose(dropped[:, 2], -0.5 * JELLY.floor.gravity * t**2, rtol=0.01, atol=1e-6)
    np.testing.assert_allclose(dropped[:, :2], 0, atol=1e-6)
    np.testing.assert_allclose(motion[0], jelly().nodes + drawn.shift, atol=1e-6)


def test_bar_rests_while_the_hands_do_and_calms_down_after_them() -> None:
    body, moved = bar(), elastic(BAR, driven=True)
    still = body.nodes[body.held]
    count = 18
    steps = (count - 1) * moved.substeps + 1
    rest = moved.simulate(np.zeros_like(body.nodes), 3, path=np.broadcast_to(still, (steps, *still.shape)))
    np.testing.assert_allclose(rest, np.broadcast_to(body.nodes, rest.shape), atol=1e-6)
    ramp = np.clip(np.arange(steps) / (4 * moved.substeps), 0, 1)
    path = still + (ramp**2 * (3 - 2 * ramp))[:, None, None] * np.array([0.0, 0.0, 0.2])
    lifted = moved.simulate(np.zeros_like(body.nodes), count, path=path)
    np.testing.assert_allclose(lifted[:, body.held], path[:: moved.substeps], atol=1e-9)
    # A lift moves the bar as a whole in the end; what swings about that gets less.
    swing = np.abs(lifted[..., 2] - body.nodes[:, 2] - 0.2).max(1)
    assert 0.02 < swing[5:].max() < 0.3 and swing[-5:].max() < swing[4:9].max()


def test_paths_of_hands_are_smooth_rigid_and_begin_at_rest() -> None:
    body, times = bar(), np.arange(600) / 240
    for kind in (*BAR.hands, *RECIPES["bar_hands_new"].hands):
        path = held_path(body, random_path(kind, np.random.default_rng(1)), times)
        np.testing.assert_allclose(path[0], body.nodes[body.held], atol=1e-12)
        assert np.abs(path[1] - path[0]).max() < 1e-4
        assert np.abs(np.diff(path, 2, axis=0)).max() < 0.004, "a jerk"
        left = path[:, body.nodes[body.held, 0] < 0]
        sides = np.linalg.norm(left - left[:, :1], axis=-1)
        np.testing.assert_allclose(sides, np.broadcast_to(sides[0], sides.shape), atol=1e-9)
        assert np.ptp(path, axis=0).max() > 0.05


def test_written_facts_and_hands_are_those_of_the_motion(moving: Path) -> None:
    falling = ObjectData(moving / "jelly_fall")
    around = falling.surroundings
    assert around.free and around.gravity == (0.0, 0.0, -5.0) and around.floor is not None
    assert falling.train_frames == range(16) and not falling.scene().pinned.any()
    held = ObjectData(moving / "bar_hands")
    scene, record = held.scene(), held.sequences[0]
    assert held.train_frames == range(11) and record.hands is not None and scene.hand is not None
    truth = held.ground_truth(record)
    assert truth is not None
    assert torch.equal(scene.hand >= 0, scene.pinned)
    assert torch.equal(scene.hand[scene.pinned], (scene.means[scene.pinned, 0] > 0).long())
    for frame in range(record.count):
        moved = record.hands.pose(frame).move(scene.means[scene.pinned], scene.hand[scene.pinned])
        assert (moved - truth.positions[frame, scene.pinned]).norm(dim=-1).max() < 1e-3 * scene.diagonal
    assert (truth.positions[-1] - truth.rest)[scene.pinned].norm(dim=-1).max() > 0.02


def test_set_of_new_paths_is_the_same_object() -> None:
    plan = replace(QUICK, kernels=60)
    old, new = (SyntheticObject(name, plan) for name in ("bar_hands", "bar_hands_new"))
    assert old.name == new.name == old.scene.name == new.scene.name
    for field in ("means", "quats", "sh", "pinned"):
        assert torch.equal(getattr(old.scene, field), getattr(new.scene, field))
    assert not set(old.recipe.hands) & set(new.recipe.hands)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["jelly_fall", "bar_hands", "bar_hands_new"])
def test_every_sequence_stays_in_view_sound_and_above_the_floor(name: str) -> None:
    moving = SyntheticObject(name, replace(QUICK, objects=(name,), frames=60))
    cameras = video_cameras(np.asarray(moving.room[0]), moving.room[1], (96,), moving.plan.views)
    for number in range(8):
        motion, _ = moving._motion(number)
        points = torch.from_numpy(moving.points.positions(motion)).float().reshape(-1, 3)
        pixel, depth = project(points, cameras.viewmats, cameras.Ks)
        assert depth.min() > 0 and pixel.min() > 0 and pixel.max() < 96
        volume = np.linalg.det(moving.points.deformation_gradients(motion))
        assert volume.min() > 0.1, "elements turned inside out"
        if name == "jelly_fall":
            landed = np.flatnonzero(motion[..., 2].min(1) < 0.01)[0]
            assert 7 <= landed <= 12 and motion[..., 2].min() > -0.01 * moving.body.diagonal
