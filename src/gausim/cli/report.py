"""`gausim report DIR…`: tables, figures and videos of runs and sweeps, as one page and as files for papers."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from gausim.cli.arguments import command_parser
from gausim.cli.output import OWN_OBJECT, end, push
from gausim.core.errors import RunError

if TYPE_CHECKING:
    from gausim.report.write import Report


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    if arguments.record:
        return _write_record(arguments)
    from gausim.report.write import summary_line, write_report

    out = arguments.out or arguments.dirs[0] / "report"
    report = write_report(
        arguments.dirs,
        out,
        title=arguments.title,
        pictures=not arguments.no_pictures,
        say=lambda text: print(text, file=sys.stderr),
    )
    if arguments.verbose:
        print("\n".join(f"wrote {path}" for path in report.files))
    result = [f"{best.title}: {best.sentence}" for best in report.openings[:1]]
    end([summary_line(report.study), *result], "page", report.files[0], *_next(report))
    return 0


def _write_record(arguments: argparse.Namespace) -> int:
    """Writes the long table of runs as a record."""
    from gausim.report.runs import find_runs
    from gausim.report.study import make_study
    from gausim.results.table import save_results

    study = make_study(find_runs(arguments.dirs), arguments.title)
    if not study.results.table:
        raise RunError(
            f"{' '.join(map(str, arguments.dirs))}: no run here is evaluated, so there is no figure. "
            "Evaluate them with `gausim evaluate RUN`."
        )
    arguments.record.parent.mkdir(parents=True, exist_ok=True)
    save_results(arguments.record, study.results)
    print(f"record: {arguments.record.resolve().as_uri()}")
    return 0


def _next(report: "Report") -> list[list[object]]:
    """Next commands for the best run, or without evaluations the commands that evaluate runs."""
    from gausim.report.runs import NOT_EVALUATED

    if not report.openings:
        trained = [run for run in report.study.runs if run.status == NOT_EVALUATED]
        return [["evaluate", run.path] for run in trained[:3]]
    best = report.openings[0]
    name = best.name if len(best.run.objects) > 1 else None
    return [["view", best.run.path], push(best.run.path, name), list(OWN_OBJECT)]


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "report",
        " Reads what `gausim evaluate` wrote into the runs; runs that failed, were killed or were not evaluated are "
        "shown as such.",
    )
    add = parser.add_argument
    add("dirs", metavar="DIR", type=Path, nargs="+", help="run directories, sweeps, or any folder of them")
    add("--out", metavar="DIR", type=Path, help="write this folder (default: report in the first DIR)")
    add("--title", default="GausSim report", help="print this heading (default: %(default)s)")
    add("--record", metavar="FILE.json", type=Path, help="write only these figures, as a small record for pages")
    add("--verbose", action="store_true", help="list the files that are written")
    add("--no-pictures", action="store_true", help="leave figures and videos out (a small page, in a second)")
    return parser
