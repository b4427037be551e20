"""Force sessions: everything that was done to an object, as a file that people can read, edit and replay.

JSON, one event a line. Forces are multiples of the weight of what they act on, a weight being its mass times the
acceleration ``gravity`` of the header; frames count steps since the session began.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import Module

from gausim.core import ConfigError, DataError, GaussianScene, SimState
from gausim.interaction.events import (
    KINDS,
    MOST_NAME,
    MOST_STEPS,
    Event,
    Force,
    Gravity,
    Impulse,
    Pin,
    Release,
    Reset,
    Unpin,
    Wind,
)
from gausim.interaction.selections import number, selection_from_json, vector, whole
from gausim.io.files import write_durably

__all__ = [
    "FORMAT", "KINDS", "MOST_BYTES", "MOST_EVENTS", "MOST_STEPS", "Entry", "Event", "Force", "ForceSession", "Gravity",
    "Impulse", "MadeWith", "Pin", "Release", "Reset", "Unpin", "Wind", "digest", "load_session", "parse_session",
    "save_session",
]  # fmt: skip

FORMAT = "gausim.session/1"
MOST_BYTES, MOST_EVENTS = 64 << 20, 200_000


@dataclass(frozen=True)
class Entry:
    """An event and when it happens.

    Attributes:
        at: steps that were made before it.
        event: what happens.
    """

    at: int
    event: Event


@dataclass(frozen=True)
class MadeWith:
    """What a session was recorded with; hashes tell whether a replay gives the same bits.

    Attributes:
        scene: name of the scene.
        scene_hash: of its Gaussians and masks.
        model_hash: of the method's numbers.
        initial_hash: of the initial state.
        initial: what the initial state is called: a sequence, or ``rest``.
        run: name of the run.
    """

    scene: str
    scene_hash: str
    model_hash: str
    initial_hash: str
    initial: str = "rest"
    run: str = ""

    @staticmethod
    def of(
        scene: GaussianScene,
        model: object,
        initial: SimState,
        *,
        settings: str = "",
        name: str = "rest",
        run: str = "",
    ) -> MadeWith:
        """Hashes what the numbers of a simulation depend on.

        Args:
            scene: the rest scene.
            model: the method: its state dict if it is a torch module, else its type.
            initial: the initial state.
            settings: of the method, whatever its state dict does not say.
            name: of the initial state.
            run: name of the run.
        """
        masks = (scene.simulated, scene.pinned)
        gaussians = (scene.means, scene.log_scales, scene.quats, scene.opacity_logits, scene.sh)
        numbers = dict(sorted(model.state_dict().items())) if isinstance(model, Module) else {}
        return MadeWith(
            scene.name,
            digest("scene", *gaussians, *masks),
            digest(type(model).__name__, settings, *numbers, *(v for v in numbers.values() if isinstance(v, Tensor))),
            digest("initial", initial.positions, initial.previous),
            name,
            run,
        )


@dataclass(frozen=True)
class ForceSession:
    """What was done to an object, and for how long.

    Attributes:
        made_with: with what.
        fps: frames per second.
        steps: frames after the initial one.
        entries: what happened, in its order.
        gravity: the acceleration that makes a weight of a mass [scene units / s^2].
        seed: of the gusts of wind.
    """

    made_with: MadeWith
    fps: float
    steps: int
    entries: tuple[Entry, ...]
    gravity: float
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("fps", "gravity"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ConfigError(f"field '{name}': expected a number > 0, got {value!r}.")
        if not 0 <= self.steps <= MOST_STEPS:
            raise ConfigError(f"field 'steps': expected 0 to {MOST_STEPS}, got {self.steps!r}.")
        if not 0 <= self.seed < 1 << 63:
            raise ConfigError(f"field 'seed': expected a whole number >= 0, got {self.seed!r}.")
        if len(self.entries) > MOST_EVENTS:
            raise ConfigError(f"field 'events': expected at most {MOST_EVENTS}, got {len(self.entries)}.")
        last = 0
        for place, entry in enumerate(self.entries):
            if not last <= entry.at <= self.steps:
                raise ConfigError(
                    f"event {place}: field 'at': expected {last} to {self.steps}, got {entry.at!r}. Events are in "
                    "the order of their time and none is after the last step."
                )
            last = entry.at


def save_session(session: ForceSession, path: Path | str) -> None:
    """Writes a session, one event a line; replaces the file atomically."""
    path = Path(path)
    header = {
        "format": FORMAT,
        "made_with": {f.name: getattr(session.made_with, f.name) for f in fields(session.made_with)},
        "fps": session.fps,
        "gravity": session.gravity,
        "seed": session.seed,
        "steps": session.steps,
    }
    lines = [f"  {json.dumps(name)}: {json.dumps(value, allow_nan=False)}" for name, value in header.items()]
    events = ",\n".join("    " + json.dumps(_to_json(entry), allow_nan=False) for entry in session.entries)
    lines.append('  "events": [' + (f"\n{events}\n  ]" if events else "]"))
    write_durably(path, ("{\n" + ",\n".join(lines) + "\n}\n").encode())


def load_session(path: Path | str) -> ForceSession:
    """Reads a session.

    Raises:
        DataError: the file is missing, too large, no JSON, of another format, or a field is wrong, unknown, missing or
            not finite; names the file, the event and the field.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if not path.is_file() or size > MOST_BYTES:
            raise DataError(f"{path}: expected a session of at most {MOST_BYTES >> 20} MiB, got {size} bytes.")
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DataError(f"{path}: no such file. Save one in `gausim view`, or with `save_session`.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as text ({error}).") from error
    return parse_session(text, str(path))


def parse_session(text: str, source: str = "session") -> ForceSession:
    """Reads a session from its text; ``source`` names it in errors.

    Raises:
        DataError: as :func:`load_session`.
    """
    try:
        value = json.loads(text, object_pairs_hook=_unique, parse_constant=_no_constant, parse_int=_integer)
        return _session(value)
    except RecursionError:
        raise DataError(f"{source}: is nested too deeply. Write the session again.") from None
    except (ConfigError, ValueError) as error:
        raise DataError(f"{source}: {error} Correct it, or record the session again.") from error


def _session(value: Any) -> ForceSession:
    names = {"format", "made_with", "fps", "gravity", "seed", "steps", "events"}
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        found = value.get("format") if isinstance(value, dict) else type(value).__name__
        raise ConfigError(f"field 'format': expected {FORMAT!r}, got {str(found)[:80]!r}.")
    _exactly(value, names)
    made = value["made_with"]
    if not isinstance(made, dict):
        raise ConfigError("field 'made_with': expected an object of texts.")
    _exactly(made, {f.name for f in fields(MadeWith)})
    if not isinstance(value["events"], list):
        raise ConfigError("field 'events': expected a list.")
    entries = []
    for place, item in enumerate(value["events"][: MOST_EVENTS + 1]):
        try:
            entries.append(_entry(item))
        except ConfigError as error:
            raise ConfigError(f"event {place}: {error}") from error
    return ForceSession(
        MadeWith(**{name: _text(f"made_with.{name}", text) for name, text in made.items()}),
        number("fps", value["fps"]),
        whole("steps", value["steps"]),
        tuple(entries),
        number("gravity", value["gravity"]),
        whole("seed", value["seed"]),
    )


def _entry(item: Any) -> Entry:
    if not isinstance(item, dict):
        raise ConfigError("expected an object with fields 'at' and 'do'.")
    kind = KINDS.get(item["do"]) if isinstance(item.get("do"), str) else None
    if kind is None:
        raise ConfigError(f"field 'do': expected one of {', '.join(KINDS)}, got {str(item.get('do'))[:80]!r}.")
    known = {f.name for f in fields(kind)}
    _exactly(item, {"at", "do", *known})
    if kind is Force:
        _text("name", item["name"])  # only a release may leave it open
    return Entry(whole("at", item["at"]), kind(**{name: _READERS[name](item[name]) for name in known}))


def _text(name: str, value: object) -> str:
    if not isinstance(value, str) or len(value) > MOST_NAME:
        raise ConfigError(f"field '{name}': expected a text of at most {MOST_NAME} characters, got {str(value)[:80]}.")
    return value


# How each field of an event is read; its range is the event's own business.
_READERS: dict[str, Callable[[Any], Any]] = {
    "on": selection_from_json,
    "direction": partial(vector, "direction"),
    "weights": partial(number, "weights"),
    "weight_seconds": partial(number, "weight_seconds"),
    "gusts": partial(number, "gusts"),
    "frames": lambda value: None if value is None else whole("frames", value),
    "name": lambda value: None if value is None else _text("name", value),
}


def _to_json(entry: Entry) -> dict[str, Any]:
    values = {f.name: getattr(entry.event, f.name) for f in fields(entry.event)}
    if "on" in values:
        values["on"] = values["on"].to_json()
    return {"at": entry.at, "do": type(entry.event).__name__.lower(), **values}


def digest(*parts: str | Tensor) -> str:
    """First half of the SHA-256 of texts and tensors (type, shape and bytes), in hexadecimal."""
    result = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            result.update(f"text {len(part)} {part};".encode())
        else:
            value = part.detach().cpu().contiguous()
            result.update(f"tensor {value.dtype} {tuple(value.shape)};".encode())
            result.update(value.view(-1).view(torch.uint8).numpy().tobytes() if value.numel() else b"")
    return result.hexdigest()[:32]


def _exactly(value: Mapping[str, Any], names: set[str]) -> None:
    missing, unknown = sorted(names - set(value)), sorted(set(value) - names)
    if missing or unknown:
        raise ConfigError(
            f"expected the fields {', '.join(sorted(names))}; missing: {missing}, unknown: {str(unknown)[:200]}."
        )


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ConfigError("a field stands there twice.")
    return result


def _no_constant(text: str) -> None:
    raise ConfigError(f"expected finite numbers, got {text}.")


def _integer(text: str) -> int:
    if len(text) > 20:
        raise ConfigError(f"expected numbers of at most 20 digits, got {text[:30]}...")
    return int(text)
