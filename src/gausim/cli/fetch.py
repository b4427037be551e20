"""`gausim fetch NAME`: fetches published runs and data sets, verified before unpacking, or packs one."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from gausim.cli.arguments import command_parser

if TYPE_CHECKING:
    from gausim.io.registry import Entry, Registry

EPILOG = """\
A registry is a TOML file that names archives with address, size, SHA-256, licence and card (docs/reference/files.md).
Nothing is unpacked before size and SHA-256 are right, and nothing in an archive is executed. An interrupted download
goes on when the same command is given again.

  gausim fetch --list --registry https://example.org/gausim/registry.toml
  gausim fetch bunny --registry registry.toml
  gausim fetch bunny --registry registry.toml --mirror /mnt/mirror      # without a network
  gausim fetch --pack outputs/bunny/seed_0 --name bunny --licence CC-BY-4.0 --out published"""


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    wanted = [bool(arguments.names), arguments.list, arguments.pack is not None]
    if sum(wanted) != 1:
        parser.error("expected either NAME, --list or --pack RUN|DIR")
    if arguments.out is not None and len(arguments.names) > 1:
        parser.error("--out is the directory of one NAME")
    if arguments.pack is not None:
        if arguments.name is None:
            parser.error("--pack: expected --name NAME, by which the entry is asked for")
        return _pack(arguments)
    from gausim.io.registry import SHIPPED, read_registry

    registry = read_registry(arguments.registry or SHIPPED)
    if arguments.list:
        _print_list(registry)
        return 0
    entries = [registry.find(name) for name in arguments.names]  # check all names before the first download
    for entry in entries:
        _fetch(entry, arguments, registry)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("fetch", epilog=EPILOG)
    add = parser.add_argument
    add("names", metavar="NAME", nargs="*", help="entries of the registry")
    add("--list", action="store_true", help="print what the registry lists")
    add("--registry", metavar="FILE|URL", help="default: the one that came with gausim")
    add("--mirror", metavar="DIR|URL", help="take the archives from here instead of their addresses")
    add(
        "--out", metavar="DIR", type=Path,
        help="directory that is made; default outputs/fetched/NAME for a run, data/NAME for a data set, published "
        "with --pack",
    )  # fmt: skip
    packing = parser.add_argument_group("publishing")
    add = packing.add_argument
    add("--pack", metavar="RUN|DIR", type=Path, help="write NAME.tar of a finished run or a data set, and its entry")
    add("--name", metavar="NAME", help="of the entry")
    add("--licence", metavar="ID", help="under which others may use it, e.g. CC-BY-4.0; default that of dataset.json")
    add("--title", metavar="TEXT", help="description in one line")
    add("--data", metavar="NAME", default="", help="of a run: the entry of its data set")
    return parser


def _print_list(registry: Registry) -> None:
    from rich.console import Console
    from rich.table import Table

    if not registry.entries:
        print(f"{registry.source}: lists nothing yet. Give another registry with --registry FILE|URL.")
        return
    shown = Table(title=registry.source, title_justify="left")
    for head in ("name", "kind", "size", "licence", "what", "card"):
        shown.add_column(head, justify="right" if head == "size" else "left", overflow="fold")
    for entry in registry.entries.values():
        shown.add_row(entry.name, entry.kind, megabytes(entry.size), entry.licence, entry.title, entry.card)
    Console().print(shown)


def _fetch(entry: Entry, arguments: argparse.Namespace, registry: Registry) -> None:
    from gausim.cli.bring import default_folder, fetch
    from gausim.io.registry import mirrored

    target = arguments.out or default_folder(entry)
    addresses = [mirrored(entry, arguments.mirror)] if arguments.mirror else list(entry.addresses)
    card = f", card {entry.card}" if entry.card else ""
    print(f"{entry.name}: {entry.title} ({entry.kind}, {megabytes(entry.size)}, licence {entry.licence}{card})")
    made = fetch(entry, target, addresses)
    print(f"{'fetched' if made else 'was fetched before'}: {target}")
    if entry.kind == "data":
        print(f"next: gausim train data=object data.root={target}")
        return
    known = registry.entries.get(entry.data)
    if known is not None:
        print(f"its data: gausim fetch {entry.data}")
    data = default_folder(known) if known is not None else "DIR"
    print(f"next: gausim evaluate {target} --data {data}")


def _pack(arguments: argparse.Namespace) -> int:
    from gausim.cli.pack import pack_published

    entry = pack_published(
        arguments.pack, arguments.out or Path("published"), name=arguments.name, title=arguments.title,
        licence=arguments.licence, data=arguments.data,
    )  # fmt: skip
    print(entry)
    return 0


def megabytes(count: int) -> str:
    """A number of bytes in MB, as text."""
    return f"{count / 1e6:,.1f} MB" if count < 1e9 else f"{count / 1e9:,.2f} GB"
