"""Teaching: the network learns the flow from single steps and rollouts on tracks, and a resumed run keeps it."""

from pathlib import Path

import pytest
import torch
from helpers.simulators import SMALLEST
from helpers.toy_object import ToyObject, toy_scene, write_object

from gausim.compose.build import build
from gausim.compose.config import compose
from gausim.core import ConfigError
from gausim.training.plan import DataFacts, Teaching, TrainingPlan
from gausim.training.stages import begin
from gausim.training.teach import Lesson
from gausim.training.tracking import Track, track

QUICK = [
    *SMALLEST, "render=cpu", "logger=none", "trainer.motion_epochs=0", "evaluate=false", "model=gausim_network",
    "plan.repeats=1", "plan.batch_size=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    toy = ToyObject(tmp_path_factory.mktemp("teach") / "toy", toy_scene(), frames=28, first_unseen=16)
    return write_object(toy).root


def test_a_network_that_is_taught_an_oscillator_has_learned_its_flow(toy: Path) -> None:
    torch.manual_seed(0)
    options = ["supervision=points", "optimizer.network_lr=4e-3", "model.simulator.network.hidden=16"]
    module, data = build(compose([f"data.root={toy}", *QUICK, *options, "plan.teach.shows=40", "plan.teach.rolls=4"]))
    whole = [  # all frames, of which the first 16 are seen
        Track(0, number, data.index.ground_truth(number).positions - module.scenes[0].means) for number in range(2)
    ]

    def left() -> float:
        """Squared error of single steps from true unseen states."""
        lesson = Lesson(module, module.model, whole, Teaching(), seed=0)
        with torch.no_grad():
            return float(lesson.errors([(i, t) for i in (0, 1) for t in range(17, 27)], 1)[0])

    module.model.eval()
    untaught = left()
    begin(module, data, module.plan, seed=0, quiet=True)
    module.model.eval()
    assert left() < 0.1 * untaught


def test_the_plan_leaves_teaching_out_where_motion_cannot_be_tracked() -> None:
    plan = TrainingPlan(warm_start=None, teach=Teaching(shows=3))
    taught, held = plan.resolved(DataFacts(2, 16, True)), plan.resolved(DataFacts(2, 16, True, can_teach=False))
    assert taught.teach == plan.teach and taught.t_start == 15 and "teach" not in taught.settings()
    assert held.teach is None and held.settings()["teach"] is None and held.t_start == 2
    assert [p.rate_factor("network", 1.0) for p in (taught, held)] == pytest.approx([0.2 * 0.05, 0.05])
    for wrong in ({"shows": -1}, {"shows": 0, "rolls": 0}, {"noise": -1.0}):
        with pytest.raises(ConfigError, match=r"plan\.teach: expected shows and rolls"):
            Teaching(**wrong)
    with pytest.raises(ConfigError, match=r"plan\.teach\.sums: expected 0 to 1"):
        Teaching(sums=1.5)


def test_kernels_move_by_the_noise_of_their_unit_and_every_pair_is_shown_once(toy: Path) -> None:
    module, data = build(compose([f"data.root={toy}", *QUICK, "supervision=points"]))
    lesson = Lesson(module, module.model, track(module, data, quiet=True), Teaching(sums=1.0), seed=0)
    pairs = [start for starts in lesson.pairs() for start in starts]
    assert sorted(pairs) == [(i, t) for i in range(2) for t in range(15)]
    batch = module.model.batch([0, 0])
    shift, unit = lesson._drawn(batch, 0.1), batch.inherited
    assert torch.equal(shift[unit < 0], torch.zeros_like(shift[unit < 0])) and bool((unit >= 0).any())
    for number in unit[unit >= 0].unique():
        own = shift[unit == number]
        assert bool((own == own[0]).all()) and float(own[0].norm()) > 0
    state = lesson.state(batch, [(0, 0), (1, 3)])
    rest = module.scenes[0].means
    expected = data.index.ground_truth(1).positions
    assert torch.equal(state.positions[: len(rest)], rest)
    assert float((state.positions[len(rest) :] - rest).norm()) > 0 and expected.shape[0] == 28


def test_lessons_on_sums_are_motions_about_rest_that_begin_with_their_states(toy: Path) -> None:
    module, data = build(compose([f"data.root={toy}", *QUICK, "supervision=points"]))
    tracks = track(module, data, quiet=True)
    lesson = Lesson(module, module.model, tracks, Teaching(sums=1.0), seed=0)
    batch, starts = module.model.batch([0, 0]), [(0, 4), (1, 7)]
    plain, true = lesson._motion(batch, starts, 3, trained=False)
    state, summed = lesson._sums(batch, starts, 3, plain, true, trained=False)
    assert torch.equal(state.positions, summed[0]) and summed.shape == true.shape == (4, len(batch.rest), 3)
    assert not torch.allclose(summed, true)
    span = torch.stack(
        [tracks[0].moved[t : t + 4] for t in range(13)] + [tracks[1].moved[t : t + 4] for t in range(13)]
    )
    parts = (summed - batch.rest).unflatten(1, (2, -1))[:, 0].flatten()  # in the span of tracked motions of this length
    span = span.flatten(1).mT.double()
    left = span @ torch.linalg.lstsq(span, parts.double()[:, None]).solution - parts.double()[:, None]
    assert float(left.norm()) < 1e-3 * float(parts.norm())
    unchanged = Lesson(module, module.model, tracks, Teaching(sums=0.0), seed=0)
    assert torch.equal(unchanged._sums(batch, starts, 3, plain, true, trained=False)[1], true)
