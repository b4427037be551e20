"""Validation of websocket messages from a browser by kind, types, sizes and ranges, before viser receives them.

viser decodes any message and sets the attributes that it names. Here only the message kinds of the page are accepted,
with exactly their fields and finite numbers; any other message raises, and its connection is closed.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Union

import msgspec
from msgspec import Meta

# A part of an uploaded file has 512 KiB; everything else is small.
LARGEST_MESSAGE = 1 << 20
LARGEST_UPLOAD = 8 << 20
UPLOADS_AT_ONCE = 2

_Real = Annotated[float, Meta(ge=-1e30, le=1e30)]  # the range excludes NaN and infinity
_Vector = tuple[_Real, _Real, _Real]
_Pixel = tuple[_Real, _Real]
_Natural = Annotated[int, Meta(ge=0, le=1 << 31)]
_Name = Annotated[str, Meta(max_length=256)]
_Part = Annotated[int, Meta(ge=0, le=64)]
_Modifier = (
    Literal["cmd/ctrl", "alt", "shift", "cmd/ctrl+alt", "cmd/ctrl+shift", "alt+shift", "cmd/ctrl+alt+shift"] | None
)
_Scalar = bool | _Real | Annotated[str, Meta(max_length=4096)] | None


def _kind(kind: str, /, tag: bool = True, **fields: Any) -> Any:
    """A message type with the given fields, each a type or (type, default)."""
    given = [(field, *(of if isinstance(of, tuple) else (of,))) for field, of in fields.items()]
    return msgspec.defstruct(kind, given, tag=tag or None, forbid_unknown_fields=True)


_KINDS = (
    _kind(
        "ViewerCameraMessage", wxyz=tuple[_Real, _Real, _Real, _Real], position=_Vector,
        fov=Annotated[float, Meta(gt=0, lt=math.pi)], near=Annotated[float, Meta(ge=0, le=1e30)],
        far=Annotated[float, Meta(gt=0, le=1e30)], image_height=_Natural, image_width=_Natural, look_at=_Vector,
        up_direction=_Vector,
    ),
    _kind(
        "ScenePointerMessage", event_type=Literal["click", "rect-select"], ray_origin=_Vector | None,
        ray_direction=_Vector | None, screen_pos=Annotated[tuple[_Pixel, ...], Meta(min_length=1, max_length=2)],
        modifier=_Modifier,
    ),
    _kind(
        "SceneNodeDragMessage", phase=Literal["start", "update", "end"], name=_Name, instance_index=_Natural | None,
        start_position=_Vector, start_screen_pos=_Pixel, end_position=_Vector, end_screen_pos=_Pixel,
        button=Literal["left", "middle", "right"], modifier=_Modifier, owner=(_Name, ""),
    ),
    # The value is the only property of an element that a browser may set.
    _kind(
        "GuiUpdateMessage", uuid=_Name,
        updates=_kind("GuiValue", tag=False, value=_Scalar | Annotated[list[_Scalar], Meta(max_length=16)]),
    ),
    _kind(
        "FileTransferStartUpload", source_component_uuid=_Name, transfer_uuid=_Name, filename=_Name, mime_type=_Name,
        part_count=_Part, size_bytes=Annotated[int, Meta(ge=0, le=LARGEST_UPLOAD)],
    ),
    _kind(
        "FileTransferPart", source_component_uuid=_Name | None, transfer_uuid=_Name, part_index=_Part, content=bytes
    ),
    _kind(
        "FileTransferPartAck", source_component_uuid=_Name | None, transfer_uuid=_Name, transferred_bytes=_Natural,
        total_bytes=_Natural,
    ),
)  # fmt: skip


class MessageError(ValueError):
    """A message that the page never sends."""


class MessageChecker:
    """Validates the messages of one connection and tracks its uploads."""

    def __init__(self) -> None:
        self._decoder = msgspec.msgpack.Decoder(Union[_KINDS])  # noqa: UP007 - of a tuple
        self._parts_left: dict[str, int] = {}

    def check(self, raw: object) -> bytes:
        """Returns the message if it is valid.

        Raises:
            MessageError: the message is not binary, of another kind or form, or has a number that is not finite.
        """
        if not isinstance(raw, bytes):
            raise MessageError("expected a binary message")
        try:
            message = self._decoder.decode(raw)
        except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
            raise MessageError(str(error)) from error
        self._count(type(message).__name__, message)
        return raw

    def _count(self, kind: str, message: Any) -> None:
        if kind == "FileTransferStartUpload":
            if message.part_count:
                self._parts_left[message.transfer_uuid] = message.part_count
            if len(self._parts_left) > UPLOADS_AT_ONCE:
                raise MessageError(f"more than {UPLOADS_AT_ONCE} uploads at once")
        elif kind == "FileTransferPart":
            left = self._parts_left.pop(message.transfer_uuid, 0) - 1
            if left < 0:
                raise MessageError("a part of no upload")
            if left:
                self._parts_left[message.transfer_uuid] = left
