"""Examination of one object: runs all checks, and omits those that another check's fault invalidates."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gausim.core import DataError, GaussianScene
from gausim.data.objects import ObjectData
from gausim.doctor.appearance import find_flicker, find_plain, find_uneven_cameras
from gausim.doctor.calibration import find_calibration_faults
from gausim.doctor.clock import find_clock_faults
from gausim.doctor.coverage import (
    find_cut_off,
    find_few_frames,
    find_few_sequences,
    find_like_directions,
    find_pins,
    find_tiny,
)
from gausim.doctor.evidence import Evidence, gather, with_bar
from gausim.doctor.finding import SEVERITIES, Check, Finding
from gausim.doctor.masks import find_mask_faults
from gausim.doctor.motion import find_odd_motion, find_unrest

CHECKS = (
    Check("pins", (find_pins,)),
    Check("extent", (find_few_frames, find_few_sequences)),
    Check("masks", (find_mask_faults,)),
    Check("calibration", (find_calibration_faults,), needs=("masks",)),
    Check("views", (find_like_directions, find_cut_off, find_tiny), needs=("masks", "calibration")),
    Check("clock", (find_clock_faults,), needs=("masks",)),
    Check("motion", (find_unrest, find_odd_motion), needs=("masks",)),
    Check("appearance", (find_plain, find_flicker, find_uneven_cameras), needs=("masks", "calibration")),
)


@dataclass(frozen=True, eq=False)
class Examination:
    """Result of the examination of one object."""

    findings: tuple[Finding, ...]  # faults first
    left_out: dict[str, str]  # omitted checks, each with the check whose fault invalidates it
    evidence: Evidence | None  # examined data; None if it could not be read

    @property
    def ruinous(self) -> bool:
        """Whether there is a fault."""
        return any(finding.severity == "fault" for finding in self.findings)

    @property
    def graver(self) -> Examination:
        """The examination without notes."""
        return replace(self, findings=tuple(f for f in self.findings if f.severity != "note"))


def examine(data: ObjectData, scene: GaussianScene | None) -> Examination:
    """Examines some frames of an object with valid files, and its rest scene, pinned or not."""
    try:
        evidence = gather(data, scene)
    except DataError as error:
        remedy = "Mend this file; `gausim verify` without --quick finds all others that cannot be read."
        return Examination((Finding("fault", "certain", str(error), remedy, check="files"),), {}, None)
    findings: list[Finding] = []
    spoilt: set[str] = set()
    left_out: dict[str, str] = {}
    for check in with_bar(CHECKS, "checks"):
        blocking = next((name for name in check.needs if name in spoilt), None)
        if blocking is not None:
            left_out[check.name] = blocking
            continue
        found = [replace(finding, check=check.name) for finder in check.finders for finding in finder(evidence)]
        findings += found
        if any(finding.severity == "fault" for finding in found):
            spoilt.add(check.name)
    findings = _without_consequences(findings)
    ordered = sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))
    return Examination(tuple(ordered), left_out, evidence)


def _without_consequences(findings: list[Finding]) -> list[Finding]:
    """Removes findings that a camera disagrees with the rest scene if its clock is early, which explains them."""
    early = {f.measured["view"] for f in findings if f.check == "clock" and f.severity != "note"}
    return [f for f in findings if f.check != "calibration" or not {*f.measured.get("views", "-")} <= early]
