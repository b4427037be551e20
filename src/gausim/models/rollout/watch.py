"""Whether a rollout stays finite, without waiting for the device at every frame."""

from __future__ import annotations

import torch
from torch import Tensor

from gausim.core import DivergenceError

INTERVAL = 64  # frames on a CUDA device between two questions; each makes the host wait until the device has caught up


class Watch:
    """Notes of one rollout, kept on its device: whether the positions and the forces at the latest frames are finite.

    On the CPU every frame is looked at at once; elsewhere some frames may be computed in vain before the error.
    """

    def __init__(self, source: str, device: torch.device) -> None:
        """Begins with nothing noted.

        Args:
            source: name of the scene, for the error.
            device: where the state is.
        """
        self.source = source
        self.interval = 1 if device.type == "cpu" else INTERVAL
        # A ring of rows, one per frame: no more than these are noted between two questions.
        self._notes = torch.ones(INTERVAL + 2, 2, dtype=torch.bool, device=device)
        self._asked = 0

    def positions(self, frame: int, *values: Tensor) -> None:
        """Notes whether the positions at a frame are finite."""
        self._note(frame, 0, values)

    def forces(self, frame: int, value: Tensor) -> None:
        """Notes whether the forces on a frame are finite."""
        self._note(frame, 1, (value,))

    def _note(self, frame: int, kind: int, values: tuple[Tensor, ...]) -> None:
        for value in values:
            self._notes[frame % len(self._notes), kind].logical_and_(torch.isfinite(value).all().to(self._notes.device))

    def ask(self, frame: int, *, now: bool = False) -> None:
        """Raises if anything noted up to this frame is not finite; looks every ``interval`` frames, or ``now``.

        Raises:
            DivergenceError: naming the first frame that is not finite.
        """
        if not now and frame % self.interval:
            return
        rows = torch.arange(self._asked, frame + 1, device=self._notes.device) % len(self._notes)
        wrong = (~self._notes[rows]).nonzero().tolist()
        if wrong:
            row, kind = wrong[0]
            raise DivergenceError(
                f"{self.source}: {('positions', 'forces')[kind]} are not finite at frame {self._asked + row}. "
                "Reset the state, or use a smaller force or a model trained longer."
            )
        self._notes[rows] = True
        self._asked = frame + 1
