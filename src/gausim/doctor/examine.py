"""Examination of one object: runs all checks, and omits those that another check's fault invalidates."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gausim.core import DataError, GaussianScene
from gausim.data.objects import ObjectData
from gausim.doctor import appearance, calibration, clock, coverage, masks, motion
from gausim.doctor.evidence import SEVERITIES, Evidence, Finding, gather
from gausim.runs.bar import with_bar

# Each check with the others whose faults invalidate it, and its finders, one per kind of fault.
CHECKS = (
    ("pins", (), (coverage.find_pins,)),
    ("kernels", (), (coverage.find_outliers,)),
    ("extent", (), (coverage.find_few_frames,)),
    ("masks", (), (masks.find_mask_faults,)),
    ("calibration", ("masks",), (calibration.find_calibration_faults,)),
    ("views", ("masks", "calibration"), (coverage.find_like_directions, coverage.find_cut_off, coverage.find_tiny)),
    ("clock", ("masks",), (clock.find_clock_faults,)),
    ("motion", ("masks",), (motion.find_unrest, motion.find_odd_motion)),
    ("appearance", ("masks", "calibration"), (appearance.find_flicker, appearance.find_uneven)),
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
        return Examination((Finding("fault", str(error), remedy, check="files"),), {}, None)
    findings: list[Finding] = []
    left_out: dict[str, str] = {}
    for name, needs, finders in with_bar(CHECKS, "checks"):
        spoilt = [finding.check for finding in findings if finding.severity == "fault" and finding.check in needs]
        if spoilt:
            left_out[name] = min(spoilt, key=needs.index)
        else:
            findings += [replace(finding, check=name) for find in finders for finding in find(evidence)]
    # A camera whose clock is early disagrees with the rest scene, too; that is no finding of its own.
    early = {view for f in findings if f.check == "clock" and f.severity != "note" for view in f.views}
    kept = [f for f in findings if f.check != "calibration" or not f.views or not {*f.views} <= early]
    ordered = sorted(kept, key=lambda finding: SEVERITIES.index(finding.severity))
    return Examination(tuple(ordered), left_out, evidence)
