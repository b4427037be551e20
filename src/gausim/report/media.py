"""Pictures of a report, as data URIs: error curves and the films of evaluations."""

import base64
import io

from gausim.core import GausSimError
from gausim.pictures.figures import error_plot, literal
from gausim.report.runs import RunRecord
from gausim.report.study import Study
from gausim.results.curves import load_curves


def film_uri(run: RunRecord, name: str) -> str:
    """The film of an object in a run's evaluation as a data URI; empty without one."""
    folder = run.path / "evaluation"
    path = folder / f"film_{name}.mp4"
    known = bool(run.objects[name].film) and path.parent == folder and path.is_file()  # names are not trusted
    return _data_uri("video/mp4", path.read_bytes()) if known else ""


def error_curves(study: Study, name: str) -> tuple[str, list[str]]:
    """Errors over time of all rows of an object, over sequences and seeds; and the reasons for missing curves."""
    rows, problems = [], list[str]()
    for group in study.groups:
        seeds = []
        for run, info in group.entries(name):
            try:
                seeds.append(load_curves(run.path / "evaluation" / "metrics.npz", {name: info})[name])
            except GausSimError as error:
                problems.append(f"{group.label}: {error}")
        rows += [(group.label, [(curves, group.method) for curves in seeds])] if seeds else []
    if not rows:
        return "", problems
    first = rows[0][1][0][0]
    figure = error_plot([*rows, (first.info.reference, [(first, first.info.reference)])])
    stream = io.BytesIO()
    literal(figure).savefig(stream, format="webp", pil_kwargs={"quality": 85})
    return _data_uri("image/webp", stream.getvalue()), problems


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
