"""Content of the viewer for a run or a bare scene: interactions, predictions, cameras."""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from gausim.cli.arguments import pinned_by
from gausim.compose.build import load_run
from gausim.compose.data_paths import data_option
from gausim.compose.live import REST, open_interaction
from gausim.compose.predict import run_object, state_of
from gausim.compose.unfilmed import open_scene
from gausim.io.ply import load_scene
from gausim.models.step.scene_model import SceneModel
from gausim.viewer.shown import Take
from gausim.viewer.subject import Subject


def run_subject(arguments: argparse.Namespace) -> Subject:
    """An object of a run, with the predictions of its recorded sequences."""
    run = load_run(arguments.what, data=data_option(arguments.data), device=arguments.device)
    state_of(run)
    item = run_object(run, arguments.objects)
    interaction = open_interaction(
        run, name=arguments.objects, sequence=arguments.sequences or REST, gravity=arguments.gravity
    )
    model: Any = run.module.model
    return Subject(
        title=f"{item.scene.name}: {item.scene.count} kernels, {run.module.method_name}",
        interaction=interaction,
        takes=[Take(f"Predicted: {record.name}", partial(item, record)) for record in item.data.sequences],
        cameras=item.data.sequences[0].cameras,
        material=model.material(item.scene_id) if isinstance(model, SceneModel) else {},
        up=arguments.up,
        sessions=arguments.sessions or arguments.what / "sessions",
    )


def scene_subject(arguments: argparse.Namespace) -> Subject:
    """A scene without a run."""
    scene = pinned_by(load_scene(arguments.what), arguments.pin)
    names = ("fps", "base", "seed", "stiffness", "damping", "gravity", "device")
    method = "untrained: template only" if arguments.base is None else f"network of {arguments.base}"
    return Subject(
        title=f"{scene.name}: {scene.count} kernels, {method}",
        interaction=open_scene(scene, **{name: getattr(arguments, name) for name in names}),
        up=arguments.up,
        sessions=arguments.sessions or Path("sessions"),
    )
