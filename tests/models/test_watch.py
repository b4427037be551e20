"""The first frame that is not finite is named, however seldom the device is asked."""

from __future__ import annotations

import pytest
import torch

from gausim.core import DivergenceError
from gausim.models.rollout import watch
from gausim.models.rollout.watch import Watch

GOOD, NAN, INF = (torch.full((4, 3), x) for x in (1.0, float("nan"), float("inf")))


def watched(interval: int, positions: dict[int, torch.Tensor], forces: dict[int, torch.Tensor]) -> int:
    """A rollout of 10 steps as the simulator's; returns how many steps were computed."""
    w = Watch("cup", torch.device("cpu"))
    w.interval = interval
    w.positions(0, GOOD, positions.get(0, GOOD))
    for n in range(10):
        if n in forces:
            w.forces(n, forces[n])
        try:
            w.ask(n)
        except DivergenceError as error:
            raise DivergenceError(f"{error} ({n} steps)") from None
        w.positions(n + 1, positions.get(n + 1, GOOD))
    w.ask(10, now=True)
    return 10


@pytest.mark.parametrize("interval", [1, 3, 64])
@pytest.mark.parametrize(
    ("positions", "forces", "message"),
    [
        ({0: NAN}, {}, "cup: positions are not finite at frame 0."),
        ({4: INF, 5: NAN, 9: NAN}, {7: NAN}, "cup: positions are not finite at frame 4."),
        ({10: NAN}, {3: GOOD}, "cup: positions are not finite at frame 10."),
        ({4: NAN}, {3: NAN}, "cup: forces are not finite at frame 3."),
        ({4: NAN}, {4: NAN}, "cup: positions are not finite at frame 4."),
        ({}, {9: INF}, "cup: forces are not finite at frame 9."),
    ],
)
def test_names_the_first(interval: int, positions: dict, forces: dict, message: str) -> None:
    with pytest.raises(DivergenceError, match=message):
        watched(interval, positions, forces)


def test_finite_rollouts_pass() -> None:
    assert watched(1, {}, {2: GOOD}) == watched(64, {3: GOOD}, {}) == 10


@pytest.mark.parametrize(("interval", "steps"), [(1, 4), (3, 6)])
def test_asks_at_its_interval(interval: int, steps: int) -> None:
    with pytest.raises(DivergenceError, match=rf"frame 4\..*\({steps} steps\)"):
        watched(interval, {4: NAN}, {})


@pytest.mark.parametrize("bad", [None, 299, 300])
@pytest.mark.parametrize("interval", [1, 64])
def test_long_rollouts_need_no_more_room(interval: int, bad: int | None) -> None:
    w = Watch("cup", torch.device("cpu"))
    w.interval = interval
    rows = w._notes.shape

    def run() -> None:
        for n in range(301):
            w.positions(n, NAN if n == bad else GOOD)
            w.ask(n)
        w.ask(300, now=True)

    if bad is None:
        run()
    else:
        with pytest.raises(DivergenceError, match=f"frame {bad}"):
            run()
    assert w._notes.shape == rows


def test_on_the_cpu_every_frame_is_looked_at() -> None:
    assert Watch("cup", torch.device("cpu")).interval == 1
    assert watch.INTERVAL > 1
