"""Messages arrive as sent; other bytes decode to the expected types or raise `Unreadable`."""

from __future__ import annotations

import os
import pickle
import random
import struct
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import inspect

from tests.drive.messages import ARRAYS, of_schema, same
from tests.drive.scenes import camera, description, step_of, table_scene
from workbench.app.worker.questions import QUESTIONS
from workbench.envs.inspection import Inspection
from workbench.episodes.row import Source
from workbench.live.messages import Answer, Event, Load, Loaded, Loading, Status
from workbench.machine.processes.wire import Call, Unpacker, Unreadable, pack, pack_message, value_type
from workbench.rescore.verdict import Rescore
from workbench.task.description import Stepped, TaskOptions

EVENTS: tuple[type, ...] = get_args(Event)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", [*EVENTS, *QUESTIONS], ids=lambda kind: kind.__name__)
@settings(max_examples=15, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.data())
def test_data_of_a_schema_is_its_message_and_other_data_is_unreadable(
    kind: type, data: st.DataObject
) -> None:
    schema = inspect.type_info(kind)
    number = 3 if kind in QUESTIONS else None
    unpacker = Unpacker(EVENTS, QUESTIONS)
    right = unpacker.message(pack((kind.__name__, number, data.draw(of_schema(schema, 0.0)))))
    assert isinstance(right.request if number else right, kind)
    try:
        wrong = unpacker.message(pack((kind.__name__, number, data.draw(of_schema(schema, 0.2)))))
    except Unreadable as error:
        assert str(error)
    else:
        # If the data passes, packing it again must give the same type.
        again = unpacker.message(pack_message(wrong))
        assert type(again) is type(wrong)


def test_every_answer_type_can_be_unpacked() -> None:
    kinds: tuple[Any, ...] = QUESTIONS
    for question in kinds:
        for kind in (value_type(question), question.part):
            with pytest.raises(Unreadable, match="Expected|in place of"):
                Unpacker().unpack(
                    pack({3: True} if kind in (str, None, type(None)) else "?"), kind or type(None)
                )


def messages() -> list[Any]:
    geometry, poses = table_scene(2)
    task = description(geometry, (camera(),))
    step = step_of(poses, success=np.array([True, False]), words=np.array(["a", "bc"]), none=np.zeros((2, 0)))
    return [
        Loading("importing"),
        Status(True, float("inf"), float("nan")),
        Loaded(task, step, {"import": 1.0}),
        Stepped(
            step, np.zeros(2, bool), snapshot=b"\0" * 99, new_parts={3: b"x"}, part_keys=(1, 2), number=7
        ),
        Inspection(1, 2, refused=(("state", "no"),)),
        Answer(3, pack(step)),
        Call(4, Load("file.py", TaskOptions(2, env_kwargs={"a": [1, None, 2.5]}), source={"f": "text"})),
        Call(
            5,
            Rescore(
                "file.py", TaskOptions(), TaskOptions(), (Source(Path("/a/b.rrd"), None, "1", "one"),), True
            ),
        ),
    ]


@pytest.mark.parametrize("message", messages(), ids=lambda message: type(message).__name__)
def test_a_message_arrives_as_sent(message: Any) -> None:
    got = Unpacker(EVENTS, QUESTIONS).message(pack_message(message))
    if isinstance(message, Status):
        assert np.isnan(got.real_time_factor) and got.steps_per_second == float("inf")
    else:
        assert same(got, message)


def test_received_arrays_are_writable_and_shared_ones_are_sent_once() -> None:
    array = np.arange(1000.0)
    packed = pack(
        {"a": array, "b": [array, array[::2]], "scalar": np.float32(2), "none": np.zeros((0, 3), "<i2")}
    )
    assert len(packed) < 12.5 * len(array)
    got = Unpacker().unpack(packed, dict[str, Any])
    assert got["a"] is got["b"][0] and np.array_equal(got["b"][1], array[::2])
    assert got["scalar"] == 2.0 and got["none"].shape == (0, 3) and got["none"].dtype == "<i2"
    got["a"] += 1
    assert got["a"][1] == 2.0 and array[1] == 1.0


class Named(msgspec.Struct):
    """A message with texts and with types that msgpack lacks."""

    text: str
    path: Path
    numbers: np.ndarray
    by_name: dict[str, float]
    inner: list[Source]


@given(
    st.text(st.characters(exclude_categories=())), st.binary(min_size=1, max_size=20), ARRAYS, st.floats(0, 1)
)
def test_a_message_with_any_text_arrives_and_keeps_its_paths(
    text: str, name: bytes, numbers: np.ndarray, one: float
) -> None:
    path = Path(os.fsdecode(name))
    sent = Named(text, path, numbers, {text: one}, [Source(path, text, text, text)])
    got = Unpacker().unpack(pack(sent), Named)
    shown = text.encode(errors="backslashreplace").decode()
    assert (got.text, got.path, got.by_name) == (shown, path, {shown: one})
    assert same(got.numbers, numbers) and got.inner == [Source(path, shown, shown, shown)]


@pytest.mark.parametrize("value", [object(), np.array([object()]), np.zeros(2, [("a", "<i4")]), lambda: None])
def test_objects_that_are_not_data_are_not_sent(value: object) -> None:
    with pytest.raises(TypeError, match="cannot be sent"):
        pack({"a": value})


def framed(message: object, arrays: bytes = b"") -> bytes:
    raw = msgspec.msgpack.encode(message)
    return struct.pack("!I", len(raw)) + raw + arrays


def array(name: str, shape: tuple[int, ...], code: int = 1) -> msgspec.msgpack.Ext:
    return msgspec.msgpack.Ext(code, msgspec.msgpack.encode((name, shape)))


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"hello",
        pickle.dumps(Loading("x")),
        framed(("Loading", None, {"activity": 3})),
        framed(("Loading", None, {})),
        framed(("dict", None, {"a": 1})),
        framed(("Load", None, {})),
        framed(("Loading", 3, {"activity": "x"})),
        framed(["Loading"]),
        framed(("LoadFailed", None, {"problem": None, "kept": True})),
        framed(("LoadFailed", None, {"problem": {"stage": "step"}, "kept": False})),
    ],
)
def test_invalid_messages_raise_unreadable(sent: bytes) -> None:
    with pytest.raises(Unreadable, match="."):
        Unpacker(EVENTS).message(sent)


INVALID_ARRAYS = [
    *(array("<f4", (3,)), array("<f4", (1 << 40, 1 << 40)), array("<f4", (-1,)), array("|O", (1,))),
    *(
        array("nonsense", (1,)),
        array("<f4", (2,), code=2),
        array("<f4", (2,), code=9),
        array("<f4,<f4", (1,)),
    ),
    *(array("<f4", (1,) * 600), msgspec.msgpack.Ext(2, b"7"), [1.0, 2.0], None),
]


@pytest.mark.parametrize("value", INVALID_ARRAYS)
def test_invalid_arrays_raise_unreadable(value: object) -> None:
    with pytest.raises(Unreadable):
        Unpacker().unpack(framed({"a": value}, b"\0" * 8), dict[str, np.ndarray])


@pytest.mark.parametrize("seed", [1, *[pytest.param(n, marks=pytest.mark.slow) for n in range(2, 30)]])
def test_corrupted_bytes_raise_only_unreadable(seed: int) -> None:
    chosen = random.Random(seed)
    unpacker = Unpacker(EVENTS)
    sent = [pack_message(message) for message in messages() if isinstance(message, Event)]
    for _ in range(1000):
        raw = bytearray(chosen.choice(sent)[:3000])
        for _ in range(chosen.randint(1, 4)):
            raw[chosen.randrange(len(raw))] = chosen.randrange(256)
        try:
            assert isinstance(unpacker.message(raw), Event)
        except Unreadable as error:
            assert str(error)
