"""The LaTeX tables obey LaTeX's rules, read token by token (no LaTeX is needed to run this)."""

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
    "begin", "end", "centering", "caption", "label", "textbf", "textit", "scriptsize", "multicolumn", "linewidth",
    "width", "ifdim", "else", "fi", "pm", "times", "to", "uparrow", "downarrow", "sigma",  # LaTeX
    "textbackslash", "textasciitilde", "textasciicircum", "textless", "textgreater", "textbar", "textquotedbl",  # T1
    "toprule", "midrule", "bottomrule", "cmidrule", "resizebox", "textcolor",  # booktabs, graphicx, xcolor
}  # fmt: skip
TOKEN = re.compile(r"\\([A-Za-z]+|.)|([{}$&#^_~%])|(\n)|([^\\{}$&#^_~%\n]+)")


class Latex:
    """Walks over a file as TeX would: groups and environments nest, mathematics ends, specials are escaped."""

    def __init__(self, text: str) -> None:
        self.environments: list[str] = []
        self.tables: list[list[str]] = []
        self.depth, self.math = 0, False
        body = "\n".join(re.sub(r"(?<!\\)%.*", "", line) for line in text.splitlines())
        for match in TOKEN.finditer(body):
            command, special, _, _ = match.groups()
            if command is not None:
                self._command(command, body[match.end() :])
            elif special:
                self._special(special)
        assert (self.environments, self.depth, self.math) == ([], 0, False)

    def _command(self, name: str, rest: str) -> None:
        if not name.isalpha():
            assert name in "&%$#_{}\\", f"\\{name}"
            return
        assert name in KNOWN, f"\\{name} is of no package that is asked for"
        if name in ("begin", "end"):
            environment = rest[1 : rest.index("}")]
            if name == "begin":
                self.environments.append(environment)
            else:
                assert self.environments.pop() == environment
                assert not self.math

    def _special(self, character: str) -> None:
        if character == "{":
            self.depth += 1
        elif character == "}":
            self.depth -= 1
            assert self.depth >= 0
        elif character == "$":
            self.math = not self.math
        elif character == "&":
            assert self.environments[-1:] == ["tabular"] and not self.math
        elif character in "^_":
            assert self.math, f"{character} outside mathematics"
        else:
            raise AssertionError(f"{character} is not escaped")


def rows_of(table: str) -> list[str]:
    lines = [line for line in table.splitlines() if line and not line.startswith("%")]
    return [line for line in lines if not line.startswith((r"\toprule", r"\midrule", r"\bottomrule", r"\cmidrule"))]


def width(row: str) -> int:
    """Columns that a row fills."""
    assert row.endswith(r" \\"), row
    cells = re.split(r"(?<!\\)&", row)
    return sum(int(m[1]) if (m := re.match(r"\s*\\multicolumn\{(\d+)\}", c)) else 1 for c in cells)


@pytest.fixture
def latex(tmp_path: Path) -> str:
    root = report_runs.write_sweep(tmp_path / "sweep")
    evaluate(write_run(root / "other", config(name=HOSTILE), model=None), make_curves(2.0, name=HOSTILE))
    write_report([root], tmp_path / "out", pictures=False)
    return (tmp_path / "out" / "tables.tex").read_text()


def test_everything_nests_and_is_escaped(latex: str) -> None:
    Latex(latex)
    assert "etc/passwd" in latex  # the hostile name is there, as text
    assert not [c for c in re.sub(r"(?m)(?<!\\)%.*$", "", latex) if ord(c) > 126]


def test_rows_fill_their_columns_between_rules_of_booktabs(latex: str) -> None:
    tables = re.findall(r"\\begin\{tabular\}\{l(c+)\}\n(.*?)\\end\{tabular\}", latex, re.S)
    assert len(tables) == latex.count(r"\begin{table*}") == latex.count(r"\caption{") > 6
    for columns, table in tables:
        rules = re.findall(r"^\\(top|mid|bottom)rule$", table, re.M)
        assert rules[0] == "top" and rules[-1] == "bottom" and "mid" in rules[1:-1]
        assert {width(row) for row in rows_of(table)} == {1 + len(columns)}
        spans = [tuple(map(int, s)) for s in re.findall(r"\\cmidrule\(lr\)\{(\d+)-(\d+)\}", table)]
        if spans:
            assert [n for a, b in spans for n in range(a, b + 1)] == list(range(2, 2 + len(columns)))
    labels = re.findall(r"\\label\{(.*?)\}", latex)
    assert len(set(labels)) == len(labels) and all(re.fullmatch(r"tab:[A-Za-z0-9-]+", label) for label in labels)
    assert r"\textbf{11.00 $\pm$ 5.52}" in latex and r"\textcolor{gray}{1.15 $\pm$ 0.12}" in latex
    assert r"% runs: full/seed\_0, full/seed\_1" in latex and r"\textit{failed}" in latex
    head = latex.splitlines()[0]
    assert all(package in head for package in ("booktabs", "graphicx", "xcolor", "T1"))
