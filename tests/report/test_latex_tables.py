"""The LaTeX tables obey LaTeX's rules, by their text (no LaTeX is needed to run this)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers import report_runs
from helpers.report_runs import config, evaluate, make_curves, write_run

from gausim.report.write import write_report

HOSTILE = r"a_b & 100% {x} \input{/etc/passwd} $y^2 #1 ~z"
# Commands of LaTeX itself and of the packages that the file's first line asks for.
KNOWN = {
    "begin", "end", "centering", "caption", "label", "textbf", "linewidth", "width", "ifdim", "else", "fi", "pm",
    "times", "to", "uparrow", "downarrow", "sigma", "div",  # LaTeX
    "textbackslash", "textasciitilde", "textasciicircum", "textless", "textgreater", "textbar", "textquotedbl",  # T1
    "toprule", "midrule", "bottomrule", "resizebox",  # booktabs, graphicx
}  # fmt: skip


def check(text: str) -> None:
    """What TeX would refuse: unknown commands, groups and environments that do not nest, specials as text."""
    body = re.sub(r"(?m)(?<!\\)%.*$", "", text)
    assert set(re.findall(r"\\([A-Za-z]+)", re.sub(r"\\\\", "", body))) <= KNOWN
    bare = re.sub(r"\\[&%$#_{}\\]", "", body)  # without what is escaped
    depth, environments = 0, []
    for brace, kind, name in re.findall(r"([{}])|\\(begin|end)(?=\{(\w+))", bare):
        depth += {"{": 1, "}": -1}.get(brace, 0)
        assert depth >= 0
        if kind == "begin":
            environments.append(name)
        elif kind:
            assert environments.pop() == name
    assert depth == 0 and environments == []
    assert not set("$^_#~%") & set(re.sub(r"\$[^$\n]*\$", "", bare))
    assert "&" not in re.sub(r"\\begin\{tabular\}.*?\\end\{tabular\}", "", bare, flags=re.S)


@pytest.fixture
def latex(tmp_path: Path) -> str:
    root = report_runs.write_sweep(tmp_path / "sweep")
    evaluate(write_run(root / "other", config(name=HOSTILE), model=None), make_curves(2.0, name=HOSTILE))
    write_report([root], tmp_path / "out", pictures=False)
    return (tmp_path / "out" / "tables.tex").read_text()


def test_everything_nests_and_is_escaped(latex: str) -> None:
    check(latex)
    assert "etc/passwd" in latex  # the hostile name is there, as text
    assert not [c for c in re.sub(r"(?m)(?<!\\)%.*$", "", latex) if ord(c) > 126]


def test_rows_fill_their_columns_between_rules_of_booktabs(latex: str) -> None:
    tables = re.findall(r"\\begin\{tabular\}\{(lc+)\}\n(.*?)\\end\{tabular\}", latex, re.S)
    assert len(tables) == latex.count(r"\begin{table*}") == latex.count(r"\caption{") > 6
    for columns, table in tables:
        assert re.findall(r"^\\(top|mid|bottom)rule$", table, re.M) == ["top", "mid", "bottom"]
        rows = [line for line in table.splitlines() if not line.endswith("rule")]
        assert all(row.endswith(r" \\") and len(re.split(r"(?<!\\)&", row)) == len(columns) for row in rows)
    labels = re.findall(r"\\label\{(.*?)\}", latex)
    assert len(set(labels)) == len(labels) and all(re.fullmatch(r"tab:[A-Za-z0-9-]+", label) for label in labels)
    assert (
        r"\textbf{11.00 $\pm$ 1.41 ($\pm$ 5.52)}" in latex
        and "% Without figures: no_hierarchy/seed_0 (failed)" in latex
    )
    assert all(package in latex.splitlines()[0] for package in ("booktabs", "graphicx", "T1"))
