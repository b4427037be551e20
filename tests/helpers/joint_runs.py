"""Settings of the smallest runs of `gausim train`, and an object beside the toy to train jointly with it."""

from pathlib import Path

import torch
from torch import Tensor

from gausim.core import Cameras
from gausim.runs.checkpoint import read_checkpoint
from helpers import toy_object
from helpers.plain import plain_scene
from helpers.simulators import SMALLEST

TINY = (
    *SMALLEST, "plan.t_start=2", "plan.t_max=2", "plan.repeats=1", "plan.epochs=2",
    "trainer.accelerator=cpu", "render=cpu", "logger=none",
)  # fmt: skip
# One of the paper's model, without pictures and dashboards.
PAPER = (
    *SMALLEST, "model=gausim_paper", "plan.t_start=1", "plan.t_max=2", "plan.repeats=1",
    "plan.batch_size=2", "plan.epochs=2", "trainer.accelerator=cpu", "render=cpu", "logger=none",
    "name=toy",
)  # fmt: skip


def other_object(root: Path) -> Path:
    """An object of other kernels, frame rate, image size, cameras, frames and sequences than the toy's."""
    means = toy_object.toy_scene().means
    scene = plain_scene(
        torch.cat((means * 2, means[9:] * 2 + 0.1)), log_scale=-1.6, opacity=2.0,
        sh=torch.rand(63, 1, 3, generator=torch.Generator().manual_seed(1)),
        pinned=torch.cat((means, means[9:]))[:, 2] < 0.1, name="other",
    )  # fmt: skip
    seen = toy_object.cameras().select([0, 1])
    smaller = seen.Ks * torch.tensor([[0.75], [0.75], [1.0]])
    cameras = Cameras(seen.viewmats, smaller, 24, 20, ("left", "right"))
    amplitudes = {"a": 0.2, "b": 0.1, "c": -0.2}
    settings = {"frames": 12, "first_unseen": 6, "fps": 50.0, "amplitudes": amplitudes, "cameras": cameras}
    return toy_object.write_object(toy_object.ToyObject(root, scene, **settings)).root


def both(toy: Path, other: Path) -> str:
    """The override that names both stores, the second pinned by its own selection."""
    return f'data.root=[{toy},{{root: {other}, selections: {{pinned: "z=0.05"}}}}]'


def weights(run: Path) -> dict[str, Tensor]:
    """What a run has learned."""
    return dict(read_checkpoint(run / "last.ckpt")["state_dict"])
