"""`gausim config WHAT`: checks a training configuration, describes all of them to editors, completes them in shells."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from importlib.resources import files

from gausim.cli.arguments import command_parser

SHELLS = ("bash", "zsh", "fish")

VALIDATE = """Composes a configuration and checks it without training: unknown keys (with the nearest known one), values
of the wrong kind, targets that may not be built, what the constructors refuse. Exits with 1 if something is wrong.

  gausim config validate experiment=bunny plan.epochs=90    as `gausim train` would be given
  gausim config validate bunny                                     an experiment of conf/
  gausim config validate MINE/experiment/a.yaml                    of `gausim train --config-dir MINE experiment=a`
  gausim config validate outputs/bunny/seed_0                      what a run was trained with
  gausim config validate FILE.yaml                                 a configuration that was saved"""

SCHEMA = """Prints the JSON schema (draft 7) of what files in conf/experiment, conf/ablation, conf/budget and conf/sweep
may set, and of the saved config.yaml of a run. Editors complete and check files by it:

  gausim config schema > gausim.schema.json
  # yaml-language-server: $schema=PATH/gausim.schema.json          the first line of a file"""

COMPLETION = """Prints a script that completes commands, options, config groups, their choices and override names:

  bash   gausim config completion bash > ~/.local/share/bash-completion/completions/gausim
  zsh    gausim config completion zsh > DIRECTORY_OF_FPATH/_gausim
  fish   gausim config completion fish > ~/.config/fish/completions/gausim.fish

What is offered is what the installed version has; the script itself does not change with it."""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit status."""
    if argv[:1] == ["complete"]:  # called by the shell scripts; any words may follow, so they bypass the parser
        from gausim.cli.completion import complete

        sys.stdout.writelines(f"{choice}\n" for choice in complete(argv[1:]))
        return 0
    arguments = _parser().parse_args(argv)
    if arguments.part == "validate":
        return _validate(arguments.what)
    if arguments.part == "schema":
        from gausim.compose.schema import training_schema

        print(json.dumps(training_schema(), indent=1))
    else:
        print((files("gausim.cli") / "shells" / f"gausim.{arguments.shell}").read_text(), end="")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("config")
    parts = parser.add_subparsers(dest="part", metavar="WHAT", required=True)

    def add(name: str, help: str, text: str) -> argparse.ArgumentParser:
        return parts.add_parser(name, help=help, description=text, formatter_class=argparse.RawDescriptionHelpFormatter)

    validate = add("validate", "compose and check a configuration without training", VALIDATE)
    validate.add_argument("what", nargs="*", metavar="FILE|KEY=VALUE", help="nothing: the default configuration")
    add("schema", "print the JSON schema of the training configuration", SCHEMA)
    completion = add("completion", "print the completion script of a shell", COMPLETION)
    completion.add_argument("shell", choices=SHELLS, metavar="SHELL", help=", ".join(SHELLS))
    return parser


def _validate(what: Sequence[str]) -> int:
    from gausim.compose.validate import faults

    found = faults(what)
    for fault in found:
        print(fault)
    if found:
        print(f"{len(found)} {'fault' if len(found) == 1 else 'faults'}", file=sys.stderr)
        return 1
    print("the configuration is in order")
    return 0
