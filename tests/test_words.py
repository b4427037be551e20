"""Words: pages, help texts and messages use the field's terms, leading zeros and short sentences."""

import ast
import contextlib
import importlib
import io
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from gausim.cli.main import COMMANDS, usage
from gausim.cli.main import command as command_of
from gausim.cli.prepare import STAGES

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LONGEST_SENTENCE = 20  # words, in the mean of a page
LONGEST_PAGE = 1500  # words; references may be longer
# Words of a dialect, and of history, each with the words that say it.
FORBIDDEN = {
    r"held back": "limited, or unseen",
    r"\btaut\b": "under tension",
    r"\bof static\b": "relative to the static baseline",
    r"\bforesees?\b|\bforeseen\b|\bforesight\b": "predict, unseen",
    r"\bshows of\b|\bshows per\b": "uses of a sequence",
    r"\blooks? at the test part\b|\blooked at\b|\bnobody had looked\b": "test evaluation",
    r"\b(?:is|are|was|were) told\b": "is given, is listed",
    r"\btells\b|\bnot tell\b|\b(?:cannot|can) be told\b|\b(?:is|was|are|were) not told\b": "states, determines",
    r"\bspoil(?:s|t|ed)?\b|\bruin(?:s|ed)?\b": "distort, make useless",
    r"\b(?:out of|in) step\b": "synchronised",
    r"\bstands? still\b": "is static, does not move",
    r"--test` has looked|, look with": "test evaluation",
    r"\b(?:today|nowadays|formerly|previously|used to be|used to have|no longer|earlier versions?)\b": "the present",
    r"\bbefore records existed\b": "the date of the record",
    r"\b(?:a|one|two) (?:third|fifth|sixth|seventh|twelfth|fifteenth)s? of\b": "a percentage",
    r"\bTPU\b": "CPU or GPU",
}
ZERO = r"(?<![\w.:\])])\.\d"  # a decimal without its leading zero; :.2f is a format


def prose(text: str) -> str:
    """A page's text without code blocks, code in a line, addresses and HTML comments."""
    text = re.sub(r"<!--.*?-->|^```.*?^```|\{\{.*?\}\}", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"(?m)^(?: {4}|\t)(?![*-] ).*$", "", text)
    text = re.sub(r"`[^`]*`", "code", text)
    return re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)


def sentences(text: str) -> list[str]:
    """The sentences of a page: no headings, no tables; an item of a list ends one."""
    lines = [line for line in prose(text).splitlines() if not re.match(r"\s*(\||#|!\[|---|\{)", line)]
    text = re.sub(r"\n\s*(?:[*-]|\d+\.) ", "\n\n", "\n" + "\n".join(lines))
    parts = re.split(r"(?<=[.!?])[)*\"”]*\s+|\n\s*\n", text)
    return [part for part in parts if len(re.findall(r"[^\W\d_]{2,}", part)) > 2]


def mean_length(text: str) -> float:
    """Words per sentence."""
    found = sentences(text)
    return sum(len(re.findall(r"\S*\w\S*", part)) for part in found) / max(len(found), 1)


def faults(text: str) -> list[str]:
    """What a text says otherwise than the style asks."""
    flat = " ".join(text.split())
    words = {word: instead for word, instead in FORBIDDEN.items() if re.search(word, flat, re.IGNORECASE)}
    zeros = re.findall(rf".{{0,20}}{ZERO}\d*", flat)
    return [f"{word} (write {instead})" for word, instead in words.items()] + zeros


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_pages(page: Path) -> None:
    text = page.read_text()
    if page.name == "CONTRIBUTING.md":  # it names what it forbids
        text = text.replace("*relative to the static baseline*", "")
    assert not faults(prose(text))
    assert mean_length(text) <= LONGEST_SENTENCE
    assert len(text.split()) <= LONGEST_PAGE or page.parent.name in ("reference", "results")


def test_all_pages_together_are_short() -> None:
    pages = [page for page in PAGES if page.parents[0] != ROOT and page != ROOT / "docs" / "results.md"]
    assert sum(len(page.read_text().split()) for page in pages) <= 18_000
    assert len((ROOT / "README.md").read_text().split()) <= 500


def test_help_texts() -> None:
    texts = {"gausim": usage()}
    mains = [(f"gausim {name}", command_of(name)) for name in COMMANDS]
    mains += [(f"gausim prepare {name}", importlib.import_module(f"data_prep.{name}").main) for name in STAGES]
    for name, main in mains:
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
            main(["--help"])
        texts[name] = said.getvalue()
    assert len(texts) > 20 and all(len(text) > 100 for text in texts.values())
    assert not {name: found for name, text in texts.items() if (found := faults(text))}


def _messages(path: Path) -> Iterator[str]:
    """The texts in a module, but docstrings: of f-strings the parts between the values."""
    tree = ast.parse(path.read_text())
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, documented) and node.body and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            if re.search(r"[a-z]{3}.* ", node.value) and "<" not in node.value:  # neither numbers nor HTML
                yield node.value


def test_messages() -> None:
    modules = [*(ROOT / "src" / "gausim").rglob("*.py"), *(ROOT / "data_prep").rglob("*.py")]
    assert len(modules) > 100
    wrong = {}
    for path in modules:
        found = [fault for message in _messages(path) for fault in faults(message)]
        if found:
            wrong[path.relative_to(ROOT).as_posix()] = found
    assert not wrong


def test_the_checks_find_what_they_look_for() -> None:
    assert faults("an error of .36 of static") and faults("It foresees the frames.") and not faults("an error of 0.36")
    assert mean_length("One two three four. Five six seven eight nine ten.") == 5
