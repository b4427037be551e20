"""What a browser may say over the websocket: kinds, types, sizes and finite numbers, checked before viser sees it.

viser decodes whatever arrives and sets the attributes that a message names. Here every message is one of the few that
the page sends, has exactly its fields, and holds no NaN; anything else raises and costs the sender its connection.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

# A part of an uploaded file has 512 KiB; everything else is small.
LARGEST_MESSAGE = 1 << 20
LARGEST_UPLOAD = 8 << 20
UPLOADS_AT_ONCE = 2

_Name = Annotated[str, Meta(max_length=256)]
_Vector = tuple[float, float, float]
_Pixel = tuple[float, float]
_Side = Annotated[int, Meta(ge=0, le=1 << 15)]
_Instance = Annotated[int, Meta(ge=0, le=1 << 31)] | None
_Modifier = (
    Literal["cmd/ctrl", "alt", "shift", "cmd/ctrl+alt", "cmd/ctrl+shift", "alt+shift", "cmd/ctrl+alt+shift"] | None
)
_Text = Annotated[str, Meta(max_length=4096)]
_Scalar = bool | int | float | _Text | None
_Value = _Scalar | Annotated[list[_Scalar], Meta(max_length=16)]


class MessageError(ValueError):
    """A message that the page would never send."""


class ViewerCameraMessage(Struct, tag=True, forbid_unknown_fields=True):
    """Pose of the viewer's camera."""

    wxyz: tuple[float, float, float, float]
    position: _Vector
    fov: Annotated[float, Meta(gt=0, lt=math.pi)]
    near: Annotated[float, Meta(ge=0)]
    far: Annotated[float, Meta(gt=0)]
    image_height: _Side
    image_width: _Side
    look_at: _Vector
    up_direction: _Vector


class ScenePointerMessage(Struct, tag=True, forbid_unknown_fields=True):
    """A rectangle drawn, or a click anywhere."""

    event_type: Literal["click", "rect-select"]
    ray_origin: _Vector | None
    ray_direction: _Vector | None
    screen_pos: Annotated[tuple[_Pixel, ...], Meta(min_length=1, max_length=2)]
    modifier: _Modifier


class SceneNodeClickMessage(Struct, tag=True, forbid_unknown_fields=True):
    """A click on a node."""

    name: _Name
    instance_index: _Instance
    ray_origin: _Vector
    ray_direction: _Vector
    screen_pos: _Pixel
    modifier: _Modifier
    owner: _Name = ""


class SceneNodeDragMessage(Struct, tag=True, forbid_unknown_fields=True):
    """A node dragged."""

    phase: Literal["start", "update", "end"]
    name: _Name
    instance_index: _Instance
    start_position: _Vector
    start_screen_pos: _Pixel
    end_position: _Vector
    end_screen_pos: _Pixel
    button: Literal["left", "middle", "right"]
    modifier: _Modifier
    owner: _Name = ""


class GuiValue(Struct, forbid_unknown_fields=True):
    """The only property of an element that a browser may set."""

    value: _Value


class GuiUpdateMessage(Struct, tag=True, forbid_unknown_fields=True):
    """An element of the panel has a new value."""

    uuid: _Name
    updates: GuiValue


class FileTransferStartUpload(Struct, tag=True, forbid_unknown_fields=True):
    """A file is about to come."""

    source_component_uuid: _Name
    transfer_uuid: _Name
    filename: _Name
    mime_type: _Name
    part_count: Annotated[int, Meta(ge=0, le=64)]
    size_bytes: Annotated[int, Meta(ge=0, le=LARGEST_UPLOAD)]


class FileTransferPart(Struct, tag=True, forbid_unknown_fields=True):
    """A part of it."""

    source_component_uuid: _Name | None
    transfer_uuid: _Name
    part_index: Annotated[int, Meta(ge=0, lt=64)]
    content: bytes


class FileTransferPartAck(Struct, tag=True, forbid_unknown_fields=True):
    """A part of a download has arrived."""

    source_component_uuid: _Name | None
    transfer_uuid: _Name
    transferred_bytes: Annotated[int, Meta(ge=0)]
    total_bytes: Annotated[int, Meta(ge=0)]


_KINDS = (
    ViewerCameraMessage
    | ScenePointerMessage
    | SceneNodeClickMessage
    | SceneNodeDragMessage
    | GuiUpdateMessage
    | FileTransferStartUpload
    | FileTransferPart
    | FileTransferPartAck
)


class MessageChecker:
    """Checks the messages of one connection; it remembers which uploads are under way."""

    def __init__(self) -> None:
        self._decoder = msgspec.msgpack.Decoder(_KINDS)
        self._parts_left: dict[str, int] = {}

    def check(self, raw: object) -> bytes:
        """Returns the message if the page could have sent it.

        Raises:
            MessageError: it is no binary message, too large, of another kind or form, or holds a number that is not
                finite.
        """
        if not isinstance(raw, bytes):
            raise MessageError("expected a binary message")
        if len(raw) > LARGEST_MESSAGE:
            raise MessageError(f"{len(raw)} bytes; at most {LARGEST_MESSAGE} are taken")
        try:
            message = self._decoder.decode(raw)
        except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
            raise MessageError(str(error)) from error
        values = msgspec.to_builtins(message, builtin_types=(bytes,))
        if not _finite(values) or (isinstance(message, GuiUpdateMessage) and _reads_as_nan(message.updates.value)):
            raise MessageError("a number is not finite")
        self._count(message)
        return raw

    def _count(self, message: object) -> None:
        if isinstance(message, FileTransferStartUpload):
            if message.part_count:
                self._parts_left[message.transfer_uuid] = message.part_count
            if len(self._parts_left) > UPLOADS_AT_ONCE:
                raise MessageError(f"more than {UPLOADS_AT_ONCE} uploads at once")
        elif isinstance(message, FileTransferPart):
            left = self._parts_left.pop(message.transfer_uuid, 0) - 1
            if left < 0:
                raise MessageError("a part of no upload")
            if left:
                self._parts_left[message.transfer_uuid] = left


def _finite(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, dict):
        return all(map(_finite, value.values()))
    if isinstance(value, list | tuple):
        return all(map(_finite, value))
    return True


def _reads_as_nan(value: Any) -> bool:
    """Whether a text stands for NaN or infinity: viser turns the value of an element into the element's type."""
    try:
        return isinstance(value, str) and not math.isfinite(float(value))
    except ValueError:
        return False
