"""Figures of bodies of a corpus: the motion predicted for them, and the material fitted to them."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import msgspec
import torch
from scipy.stats import spearmanr
from torch import Tensor

from gausim.core import DivergenceError
from gausim.data.pretraining import BodyData, CorpusDataModule
from gausim.io.files import write_json
from gausim.metrics.motion import motion_energy
from gausim.models.hierarchy.units import fixed_units
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import MaterialTemplate
from gausim.nn.mode import evaluating
from gausim.training.module import GausSimModule

# Frames of the second range after the last seen frame.
NEAR = 10
FAR = 10.0  # error of a prediction that is not finite [diagonals]
FEWEST = 3  # values of a rank correlation
FILE = "corpus.json"


class BodyFigures(msgspec.Struct, frozen=True):
    """Figures of one body; sums over its sequences and the frames of each range, in diagonals."""

    name: str  # of the body
    material: str  # kind of its material: even, split, halves or smooth
    # distance of the predicted kernels from the true ones: seen frames, the ten after, all unseen ones
    error: tuple[float, float, float]
    static: tuple[float, float, float]  # the same of the rest state
    energy: tuple[float, float]  # predicted and true motion energy of the unseen frames
    period: float  # true period of the slowest mode [s]
    fitted_period: float | None  # that of the fitted material [s]; None where the material was given
    # rank correlation of fitted and true stiffness over the free units; None where it is even or given
    within: float | None


class CorpusFigures(msgspec.Struct, frozen=True):
    """Figures of all bodies together."""

    bodies: int  # number of bodies
    # error over the static prediction's, of the sums over all bodies: seen, the ten frames after, unseen
    error: tuple[float, float, float]
    median: float  # median over bodies of the unseen error over the static prediction's
    energy: float  # predicted over true motion energy of the unseen frames
    # rank correlation over bodies of the fitted and true stiffness; motion shows it relative to density and size,
    # as (1 / period of the slowest mode)^2
    stiffness: float | None
    within: float | None  # mean over bodies of two materials of the rank correlation of stiffness over the units
    within_smooth: float | None  # the same over bodies whose stiffness varies smoothly


@torch.no_grad()
def body_figures(module: GausSimModule, data: CorpusDataModule) -> list[BodyFigures]:
    """Predicts all sequences of the bodies held out from frame 0 and measures them."""
    found, first, model = [], 0, cast(GausSim, module.model)
    with evaluating(module):
        for scene_id, item in enumerate(cast("list[BodyData]", data.objects)):
            if scene_id in data.watched:
                material = (None, None) if data.knows_material else _fitted(model, scene_id, item)
                found.append(_figures(module, item, first, *material))
            first += len(item.sequences)
    return found


def _figures(
    module: GausSimModule, item: BodyData, first: int, fitted: float | None, within: float | None
) -> BodyFigures:
    body, seen = item.body, item.train_frames.stop
    ranges = slice(1, seen), slice(seen, seen + NEAR), slice(seen, None)
    error, static, energy = torch.zeros(3), torch.zeros(3), torch.zeros(2)
    for record in item.sequences:
        truth = body.positions[record.number, 1:]
        try:
            made = module.predict(first + record.number, len(truth) - 1).positions.to(truth)
        except DivergenceError:
            made = truth + FAR * body.record.diagonal
        for total, points in ((error, made), (static, body.rest.expand_as(truth))):
            away = (points - truth).norm(dim=-1).mean(-1) / body.record.diagonal
            total += torch.stack([away[span].sum() for span in ranges])
        energy += torch.stack([motion_energy(x)[seen - 1 :].sum() for x in (made, truth)]) / body.record.diagonal**2
    sums = {"error": tuple(error.tolist()), "static": tuple(static.tolist()), "energy": tuple(energy.tolist())}
    facts: dict[str, Any] = {"name": item.name, "material": body.record.material, **sums}
    return BodyFigures(**facts, period=body.record.period / body.fps, fitted_period=fitted, within=within)


def _fitted(model: GausSim, scene_id: int, item: BodyData) -> tuple[float, float | None]:
    """Period of the slowest mode of the fitted material [s], and the rank correlation of stiffness over units."""
    template, body = cast(MaterialTemplate, model.template), item.body
    batch = model.batch((scene_id,))
    mass, _, (*_, unit) = model.units(batch)
    period = template.slowest_period(scene_id, unit.log_density, unit.attributes)
    if body.record.material == "even":
        return period, None
    true = body.stiffness.index_select(0, model.hierarchies[scene_id].kernels).log()[:, None].to(unit.attributes)
    level = fixed_units(batch, mass, true)[1][-1].attributes[:, 0]
    free = ~batch.levels[-1].pinned
    fitted = model.material_of_units(scene_id)["stiffness"].values
    return period, _ranks(fitted[free], level[free])


def summary(found: Sequence[BodyFigures]) -> CorpusFigures:
    """The figures of all bodies together."""
    error, static, energy = (torch.tensor([getattr(x, name) for x in found]) for name in ("error", "static", "energy"))
    fitted = [x for x in found if x.fitted_period is not None]
    stiffness = _ranks(*(torch.tensor([-getattr(x, n) for x in fitted]) for n in ("fitted_period", "period")))
    within = [
        [x.within for x in found if x.within is not None and (x.material == "smooth") == smooth]
        for smooth in (False, True)
    ]
    return CorpusFigures(
        len(found), tuple((error.sum(0) / static.sum(0)).tolist()), float((error / static)[:, 2].median()),
        float(energy[:, 0].sum() / energy[:, 1].sum()), stiffness,
        *(sum(values) / len(values) if values else None for values in within),
    )  # fmt: skip


def write_figures(folder: Path, found: Sequence[BodyFigures], *, seen: int, pretrained: int | None) -> CorpusFigures:
    """Writes ``corpus.json`` with the number of seen frames, and returns the summary.

    ``pretrained`` is the number of bodies that the network was trained on; None where it is unknown.
    """
    whole = summary(found)
    folder.mkdir(parents=True, exist_ok=True)
    facts = {"seen": seen, "pretrained": pretrained, "all": whole, "bodies": list(found)}
    write_json(folder / FILE, msgspec.to_builtins(facts))
    return whole


def sentences(whole: CorpusFigures) -> list[str]:
    """The summary in two sentences."""
    seen, near, unseen = whole.error
    lines = [
        f"{whole.bodies} bodies: 3D error over static's {seen:.3f} in seen frames, {near:.3f} in the ten after, "
        f"{unseen:.3f} in all unseen ones (median of bodies {whole.median:.3f}), motion energy {whole.energy:.2f}."
    ]
    known = {"over bodies": whole.stiffness, "within bodies of two materials": whole.within,
             "within smooth ones": whole.within_smooth}  # fmt: skip
    told = [f"{value:.2f} {name}" for name, value in known.items() if value is not None]
    return lines + ([f"Rank correlation of fitted and true stiffness: {', '.join(told)}."] if told else [])


def _ranks(made: Tensor, true: Tensor) -> float | None:
    if len(made) < FEWEST:
        return None
    found: Any = spearmanr(made.cpu().numpy(), true.cpu().numpy())
    return None if math.isnan(found.statistic) else float(found.statistic)
