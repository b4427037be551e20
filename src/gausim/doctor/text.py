"""Output of findings: text and plain data."""

import textwrap
from dataclasses import asdict
from typing import Any

from gausim.doctor.evidence import SEVERITIES, listed
from gausim.doctor.examine import Examination

_WIDTH = 118


def findings_text(root: str, examination: Examination) -> str:
    """All findings of an object, for a terminal."""
    lines = [f"{root}: {summary_line(examination)}"]
    for finding in examination.findings:
        head = f"  {finding.severity.upper()}  {finding.check}: {finding.what}"
        lines += textwrap.wrap(head, _WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)
        lines += textwrap.wrap(f"Remedy: {finding.remedy}", _WIDTH, initial_indent="    ", subsequent_indent="    ",
                               break_long_words=False, break_on_hyphens=False)  # fmt: skip
    for cause in dict.fromkeys(examination.left_out.values()):
        names = listed([name for name, other in examination.left_out.items() if other == cause])
        lines.append(f"  Not checked until the fault of '{cause}' is mended: {names}.")
    return "\n".join(lines)


def summary_line(examination: Examination) -> str:
    """Number of findings of each severity, and of the frames and views that were examined."""
    counts = [(severity, sum(f.severity == severity for f in examination.findings)) for severity in SEVERITIES]
    told = ", ".join(f"{n} {severity}{'s' if n > 1 else ''}" for severity, n in counts if n)
    if not counts[0][1] and not counts[1][1]:
        told = "nothing is wrong"
    evidence = examination.evidence
    if evidence is None:
        return f"{told}."
    frames = max(len(item.alpha) for item in evidence.watched)
    return (
        f"{told} ({len(evidence.views)} cameras, {evidence.sequences} sequences; checked frames 0 to {frames - 1} of "
        f"{len(evidence.watched)} and frame 0 of {len(evidence.first)})."
    )


def plain_findings(examination: Examination) -> dict[str, Any]:
    """Findings and omitted checks as plain data for JSON."""
    return {"findings": [asdict(finding) for finding in examination.findings], "left_out": examination.left_out}
