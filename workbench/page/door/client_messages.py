"""Decodes the websocket messages of a page into typed structures."""

from __future__ import annotations

import math
from typing import Annotated, Literal, TypeVar

import msgspec

T = TypeVar("T")

MAX_BYTES = 256 * 1024
"""Maximum size of a message. The largest is a pasted text: viser's pictures of a view are never requested."""
MAX_NUMBER = 1e12
"""Maximum absolute value of a number of a camera, a ray or a gizmo, in any unit."""
MAX_SIDE_PIXELS = 100_000
"""Maximum length of one side of a page."""

Name = Annotated[str, msgspec.Meta(max_length=1024)]
Uuid = Annotated[str, msgspec.Meta(max_length=64)]
Pair = tuple[float, float]
Triple = tuple[float, float, float]
Quadruple = tuple[float, float, float, float]
Modifier = Literal[
    "cmd/ctrl", "alt", "shift", "cmd/ctrl+alt", "cmd/ctrl+shift", "alt+shift", "cmd/ctrl+alt+shift"
]


class MalformedMessage(ValueError):
    """A frame that no page of ours sends; the connection must be closed."""


class ImpossibleValue(ValueError):
    """An impossible number in a well-formed message; the message must be dropped."""


class ClientMessage(msgspec.Struct, tag_field="type", tag=True, forbid_unknown_fields=True):
    """Base of the messages below, which have the fields of viser's message of the same name.

    A frame is decoded directly into its structure and refused at the first byte that does not fit, so that megabytes of
    nested lists never become millions of Python objects on the event loop.
    """

    def check(self) -> None:
        """
        Raises:
            ImpossibleValue: A number is not finite, or far out of range.
        """


class CommandTriggerMessage(ClientMessage):
    uuid: Uuid


class ScenePointerMessage(ClientMessage):
    event_type: Literal["click"]
    ray_origin: Triple
    ray_direction: Triple
    screen_pos: tuple[Pair]
    modifier: Modifier | None

    def check(self) -> None:
        _check_numbers(*self.ray_origin, *self.ray_direction, *self.screen_pos[0])


class SceneNodeDragMessage(ClientMessage):
    phase: Literal["start", "update", "end"]
    name: Name
    instance_index: int | None
    start_position: Triple
    start_screen_pos: Pair
    end_position: Triple
    end_screen_pos: Pair
    button: Literal["left", "middle", "right"]
    modifier: Modifier | None
    owner: Name = ""

    def check(self) -> None:
        _check_numbers(*self.start_position, *self.start_screen_pos)
        _check_numbers(*self.end_position, *self.end_screen_pos)


class TransformControlsDragEndMessage(ClientMessage):
    name: Name
    owner: Name = ""


class TransformControlsDragStartMessage(ClientMessage):
    name: Name
    owner: Name = ""


class TransformControlsUpdateMessage(ClientMessage):
    name: Name
    wxyz: Quadruple
    position: Triple
    owner: Name = ""

    def check(self) -> None:
        _check_numbers(*self.position)
        _check_rotation(self.wxyz)


class ViewerCameraMessage(ClientMessage):
    wxyz: Quadruple
    position: Triple
    fov: float
    near: float
    far: float
    # float: some browsers report half pixels.
    image_height: float
    image_width: float
    look_at: Triple
    up_direction: Triple

    def check(self) -> None:
        _check_rotation(self.wxyz)
        _check_numbers(*self.position, *self.look_at, *self.up_direction, self.near, self.far)
        if not 0 < self.fov < math.pi:
            raise ImpossibleValue("a field of view that no camera has")
        # A page whose view is folded reports 0 by 0.
        if not (0 <= self.image_height <= MAX_SIDE_PIXELS and 0 <= self.image_width <= MAX_SIDE_PIXELS):
            raise ImpossibleValue("a size that no page has")


KINDS: dict[str, type[ClientMessage]] = {kind.__name__: kind for kind in ClientMessage.__subclasses__()}


class _Any(msgspec.Struct):
    type: str


_kind_decoder = msgspec.msgpack.Decoder(_Any)
_decoders = {name: msgspec.msgpack.Decoder(kind) for name, kind in KINDS.items()}


def _decoded(decoder: msgspec.msgpack.Decoder[T], raw: bytes | msgspec.Raw, problem: ValueError) -> T:
    try:
        return decoder.decode(raw)
    # ValidationError is a subclass of DecodeError; the others come from endless nesting and text that is not UTF-8.
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError, OverflowError):
        raise problem from None


def kind_of(raw: object) -> str:
    """The ``type`` of a frame; other fields are skipped.

    Raises:
        MalformedMessage: The frame is text, too long, not msgpack, or without a type.
    """
    if not isinstance(raw, bytes):
        raise MalformedMessage("a text frame")
    if len(raw) > MAX_BYTES:
        raise MalformedMessage("a message that is too long")
    return _decoded(_kind_decoder, raw, MalformedMessage("what is not a message")).type


def read_message(raw: bytes, kind: str) -> ClientMessage:
    """Decode `raw`, a message of this kind.

    Raises:
        MalformedMessage: Fields are missing, unknown, or have a wrong type or length.
        ImpossibleValue: A number is not finite, or far out of range.
    """
    message = _decoded(_decoders[kind], raw, MalformedMessage(f"wrong fields in {kind}"))
    message.check()
    return message


def _check_numbers(*numbers: float) -> None:
    # In this form NaN fails too: every comparison with it is false.
    if not all(abs(number) <= MAX_NUMBER for number in numbers):
        raise ImpossibleValue("a number that is not finite, or too large")


def _check_rotation(wxyz: Quadruple) -> None:
    if not 0.5 <= math.hypot(*wxyz) <= 2.0:
        raise ImpossibleValue("an invalid rotation")
