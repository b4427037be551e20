"""Events that act on an object, and force sessions: recorded events as a file to read, edit and replay.

JSON, one event a line. Forces are multiples of the weight of the part that they act on, its mass times the acceleration
``gravity`` of the header; frames count steps since the session began.
"""

import hashlib
import json
import math
from pathlib import Path
from typing import Annotated, Any, get_args

import msgspec
import torch
from msgspec import Meta
from torch import Tensor
from torch.nn import Module

from gausim.core import ConfigError, DataError, GaussianScene, HandPath, SimState
from gausim.interaction.checked import Checked, Natural, Vector, made
from gausim.interaction.selections import Selected, Whole, selection_from_json, selection_to_json
from gausim.io.files import write_durably

FORMAT = "gausim.session/1"
MOST_BYTES, MOST_EVENTS, MOST_STEPS = 64 << 20, 200_000, 100_000
_Amount = Annotated[float, Meta(ge=0, lt=1e9)]
_Positive = Annotated[float, Meta(gt=0, lt=1e9)]
_Factor = Annotated[float, Meta(ge=1e-3, le=1e3)]
_Name = Annotated[str, Meta(min_length=1, max_length=200)]
_Text = Annotated[str, Meta(max_length=200)]


class _EventBase(Checked, frozen=True):
    """Base of events, with a ``direction`` of any non-zero length if they have one.

    The size of a force, ``weights``, is in weights of the free kernels that it acts on; it does not act on pinned ones.
    """

    def __post_init__(self) -> None:
        Checked.__post_init__(self)
        direction = getattr(self, "direction", (1.0,))
        if not 1e-12 < math.hypot(*direction) < 1e12:
            raise ConfigError(f"field 'direction': expected a vector that is not zero, got {direction}.")


class Force(_EventBase, frozen=True):
    """A force until its release, or for some frames; it replaces an earlier force of the same name."""

    on: Selected
    direction: Vector
    weights: _Amount
    frames: Annotated[int, Meta(ge=1, le=MOST_STEPS)] | None = None
    name: _Name = "force"


class Release(_EventBase, frozen=True):
    """Ends the force with a name, or all forces."""

    name: _Name | None = None


class Impulse(_EventBase, frozen=True):
    """An impulse within one frame; one weight second gives the speed that the weight gives in one second."""

    on: Selected
    direction: Vector
    weight_seconds: _Amount


class Gravity(_EventBase, frozen=True):
    """Gravity in addition to that of the recording, until the next such event; 0 weights for none."""

    direction: Vector
    weights: _Amount


class Wind(_EventBase, frozen=True):
    """A wind, until the next such event: a force on every kernel in proportion to its cross-section."""

    direction: Vector
    weights: _Amount  # force on the whole object, averaged over time [weights of the object]; 0 for none
    gusts: Annotated[float, Meta(ge=0, le=1)] = 0.0  # relative amplitude of gusts, in 0..1


class Pin(_EventBase, frozen=True):
    """Pins kernels at their current positions."""

    on: Selected


class Unpin(_EventBase, frozen=True):
    """Releases kernels pinned by events; pinned kernels of the scene stay pinned."""

    on: Selected = Whole()


class Hand(_EventBase, frozen=True):
    """Moves the pins of a hand smoothly to a place relative to rest, and holds them there."""

    to: Vector  # displacement from rest [scene units]
    frames: Annotated[int, Meta(ge=1, le=MOST_STEPS)] = 1  # duration of the motion
    turn: Vector = (0.0, 0.0, 0.0)  # rotation about the middle of the hand's pins, axis times angle [radian]
    # number of the hand; an object without recorded hands has one, which holds all pins
    hand: Annotated[int, Meta(ge=0, lt=1000)] = 0


class Material(_EventBase, frozen=True):
    """Changes the material of the whole object, which goes on from where it is.

    Attributes:
        stiffness: over that at the beginning of the session.
        damping: over that at the beginning of the session.
    """

    stiffness: _Factor = 1.0
    damping: _Factor = 1.0


class Reset(_EventBase, frozen=True):
    """Returns to the initial state without forces, wind, gravity or pins; the material stays."""


Event = Force | Release | Impulse | Gravity | Wind | Pin | Unpin | Hand | Material | Reset
KINDS: dict[str, type] = {kind.__name__.lower(): kind for kind in get_args(Event)}


class Entry(Checked, frozen=True):
    """An event and its time."""

    at: Natural  # number of steps before it
    event: Event  # the event


class MadeWith(Checked, frozen=True):
    """Provenance of a session; a replay with equal hashes is bit-identical."""

    scene: _Text  # name of the scene
    scene_hash: _Text  # hash of its Gaussians and masks
    model_hash: _Text  # hash of the method's weights and settings
    initial_hash: _Text  # hash of the initial state
    initial: _Text = "rest"  # name of the initial state: a sequence, or ``rest``
    run: _Text = ""  # name of the run

    @staticmethod
    def of(
        scene: GaussianScene,
        model: object,
        initial: SimState,
        *,
        settings: str = "",
        name: str = "rest",
        run: str = "",
        path: HandPath | None = None,
    ) -> "MadeWith":
        """Hashes the inputs of a simulation: the rest scene, the method and the initial state called ``name``.

        A method is identified by its type, by its state dict if it is a torch module, and by ``settings``, a text of
        its other parameters. A recorded ``path`` of hands counts as part of the initial state.
        """
        masks = (scene.simulated, scene.pinned)
        gaussians = (scene.means, scene.log_scales, scene.quats, scene.opacity_logits, scene.sh)
        moved = () if path is None else (path.rotations, path.centres)
        numbers = dict(sorted(model.state_dict().items())) if isinstance(model, Module) else {}
        return MadeWith(
            scene.name,
            digest("scene", *gaussians, *masks),
            digest(type(model).__name__, settings, *numbers, *(v for v in numbers.values() if isinstance(v, Tensor))),
            digest("initial", initial.positions, initial.previous, *moved),
            name,
            run,
        )


class ForceSession(Checked, frozen=True):
    """The events on an object and the number of frames."""

    made_with: MadeWith  # provenance
    fps: _Positive  # frames per second
    steps: Annotated[int, Meta(ge=0, le=MOST_STEPS)]  # frames after the initial one
    entries: tuple[Any, ...]  # the events, in order of time
    gravity: _Positive  # ratio of weight to mass [scene units / s^2]
    seed: Natural = 0  # seed of the gusts of wind

    def __post_init__(self) -> None:
        Checked.__post_init__(self)
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

    def differences(self, here: MadeWith, fps: float) -> list[tuple[str, bool]]:
        """Differences of its header from an interaction's: text, and whether a replay can accept it."""
        made = self.made_with
        found = [
            (made.scene_hash != here.scene_hash,
             f"it is of another scene, '{made.scene}' and not '{here.scene}'", False),
            (self.fps != fps, f"it has {self.fps:g} frames per second and not {fps:g}", False),
            (made.model_hash != here.model_hash,
             f"it was made with another method or training (run '{made.run}')", True),
            (made.initial_hash != here.initial_hash,
             f"it begins at another state, '{made.initial}' and not '{here.initial}'", True),
        ]  # fmt: skip
        return [(text, allowed) for differs, text, allowed in found if differs]


def save_session(session: ForceSession, path: Path | str) -> None:
    """Writes a session, one event a line; replaces the file atomically."""
    header = {name: getattr(session, name) for name in ("fps", "gravity", "seed", "steps")}
    header = {"format": FORMAT, "made_with": msgspec.structs.asdict(session.made_with)} | header
    lines = [f"  {json.dumps(name)}: {json.dumps(value, allow_nan=False)}" for name, value in header.items()]
    events = ",\n".join("    " + json.dumps(_to_json(entry), allow_nan=False) for entry in session.entries)
    lines.append('  "events": [' + (f"\n{events}\n  ]" if events else "]"))
    write_durably(Path(path), ("{\n" + ",\n".join(lines) + "\n}\n").encode())


def load_session(path: Path | str) -> ForceSession:
    """Reads a session.

    Raises:
        DataError: the file is missing or too large, or its text is invalid, see :func:`parse_session`.
    """
    path = Path(path)
    try:
        if (size := path.stat().st_size) > MOST_BYTES:
            raise DataError(f"{path}: expected a session of at most {MOST_BYTES >> 20} MiB, got {size} bytes.")
        return parse_session(path.read_bytes(), str(path))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}). Save a session in `gausim view`.") from error


def parse_session(text: str | bytes, source: str = "session") -> ForceSession:
    """Parses a session from its UTF-8 text; error messages call it ``source``.

    Raises:
        DataError: the text is no JSON, of another format, or a field is invalid, unknown, missing or not finite; the
            message names the event and the field.
    """
    place = ""
    try:
        value = msgspec.json.decode(text)
        found = value.pop("format", None) if isinstance(value, dict) else type(value).__name__
        if found != FORMAT:
            raise ConfigError(f"field 'format': expected {FORMAT!r}, got {str(found)[:80]!r}.")
        events = value.pop("events", None)
        if not isinstance(events, list):
            raise ConfigError("field 'events': expected a list.")
        place = "field 'made_with': "
        value["made_with"] = made(MadeWith, value.get("made_with"))
        entries = []
        for number, item in enumerate(events[: MOST_EVENTS + 1]):
            place = f"event {number}: "
            entries.append(_entry(item))
        place = ""
        session: ForceSession = made(ForceSession, value | {"entries": tuple(entries)})
    except RecursionError:
        raise DataError(f"{source}: is nested too deeply. Write the session again.") from None
    except (msgspec.DecodeError, UnicodeDecodeError, ConfigError) as error:
        what = str(error).removesuffix(".")
        raise DataError(f"{source}: {place}{what}. Correct it, or record the session again.") from error
    return session


def _entry(item: Any) -> Entry:
    if not isinstance(item, dict):
        raise ConfigError("expected an object with fields 'at' and 'do'.")
    at, do = item.pop("at", None), item.pop("do", None)
    if not isinstance(do, str) or do not in KINDS:
        raise ConfigError(f"field 'do': expected one of {', '.join(KINDS)}, got {str(do)[:80]!r}.")
    if "on" in item:
        item["on"] = selection_from_json(item["on"])
    return Entry(at, made(KINDS[do], item))


def _to_json(entry: Entry) -> dict[str, Any]:
    values = msgspec.structs.asdict(entry.event)
    if "on" in values:
        values["on"] = selection_to_json(values["on"])
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
            result.update(value.view(-1).view(torch.uint8).numpy().tobytes())
    return result.hexdigest()[:32]
