"""What a page claims that a control holds: impossible values reach neither viser nor any other page."""

from __future__ import annotations

import contextlib
import itertools
import logging
import threading
from collections.abc import Callable, Iterator

import msgspec
import pytest
import viser
import viser._messages
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed
from websockets.sync.connection import Connection

from tests.drive.waiting import until
from tests.ui.knocking import CAMERA, claim, client, close_code, say
from tests.ui.tabs import messages_in
from workbench.ui.server import page_guard
from workbench.ui.server.control_values import LONGEST_LINE
from workbench.ui.server.gated_server import GatedServer, ServerOptions, open_server
from workbench.ui.server.viser_private import element_id

with_fixtures = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
NUMBERS = st.integers(-(2**63), 2**64 - 1) | st.floats() | st.sampled_from([1e30, -1e30, 2**53 + 1, 1e308])
ANYTHING = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.text(max_size=8) | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


@pytest.fixture(scope="module")
def gated_server() -> Iterator[GatedServer]:
    """One for all that is tried on it."""
    gated_server = open_server(ServerOptions(port=0))
    yield gated_server
    gated_server.close()


@pytest.fixture
def bystander(gated_server: GatedServer) -> Iterator[Callable[[], None]]:
    """A page that was there before; call it to see that it still works, and still hears of others' changes."""
    box = gated_server.server.gui.add_checkbox("alive", False)
    heard: list[bool] = []

    def listen(connection: Connection) -> None:
        for frame in connection:
            assert isinstance(frame, bytes)
            for message in messages_in(frame):
                if message["type"] == "GuiUpdateMessage" and message["uuid"] == element_id(box):
                    heard.append(message["updates"]["value"])

    with client(gated_server) as reader, client(gated_server) as other:
        thread = threading.Thread(target=listen, args=(reader,))
        thread.start()

        def works() -> None:
            wanted = not box.value
            before = len(heard)
            say(other, claim(box, wanted))
            until(lambda: heard[before:] == [wanted], "what the other page changed")

        works()
        yield works
        reader.close()
        thread.join()
    box.remove()


@pytest.fixture
def hands_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_guard, "HANDS_OFF", 0.05)


def caught_up(gated_server: GatedServer, connection: Connection) -> None:
    """Return when all that this page said before was taken or dropped."""
    box = gated_server.server.gui.add_checkbox("after", False)
    say(connection, claim(box, True))
    until(lambda: box.value, "what was said last")
    box.remove()


CONTROLS: dict[str, Callable[[viser.GuiApi], viser.GuiInputHandle | viser.GuiButtonHandle]] = {
    "checkbox": lambda gui: gui.add_checkbox("box", False),
    "button": lambda gui: gui.add_button("press"),
    "group": lambda gui: gui.add_button_group("", ("a", "b")),  # type: ignore[return-value]
    "dropdown": lambda gui: gui.add_dropdown("pick", ("a", "b")),
    "text": lambda gui: gui.add_text("text", "x"),
    "long text": lambda gui: gui.add_text("text", "x", multiline=True),
    "int": lambda gui: gui.add_number("int", 3, min=1, max=9),
    "free int": lambda gui: gui.add_number("int", 3),
    "float": lambda gui: gui.add_number("float", 3.0, min=1.0),
    "free float": lambda gui: gui.add_number("float", 3.0),
    "int slider": lambda gui: gui.add_slider("slider", 1, 9, 1, 3),
    "slider": lambda gui: gui.add_slider("slider", 0.0, 10.0, 0.1, 5.0),
    "two": lambda gui: gui.add_vector2("two", (0.0, 0.0), min=(-1.0, -1.0)),
    "three": lambda gui: gui.add_vector3("three", (0.0, 0.0, 0.0)),
    "several": lambda gui: gui.add_multi_slider("several", 0, 10, 1, (2, 5)),
    "colour": lambda gui: gui.add_rgb("colour", (1, 2, 3)),
    "see-through": lambda gui: gui.add_rgba("colour", (1, 2, 3, 4)),
    "upload": lambda gui: gui.add_upload_button("upload"),  # type: ignore[return-value]
}


@pytest.fixture
def controls(gated_server: GatedServer) -> Iterator[dict[str, viser.GuiInputHandle]]:
    made = {name: make(gated_server.server.gui) for name, make in CONTROLS.items()}
    yield made  # type: ignore[misc]
    for control in made.values():
        control.remove()


@pytest.fixture
def attacker(gated_server: GatedServer) -> Iterator[Connection]:
    with client(gated_server) as connection:
        yield connection


@pytest.mark.filterwarnings("ignore:Do not use the `random` module")  # the connection's threads do, meanwhile
@with_fixtures
@given(st.sampled_from(sorted(CONTROLS)), ANYTHING | st.lists(NUMBERS, min_size=2, max_size=4))
def test_whatever_is_claimed_a_control_holds_what_it_can_hold(gated_server, controls, attacker, name, value):
    control = controls[name]
    say(attacker, claim(control, value))
    caught_up(gated_server, attacker)
    held = control.value
    # What viser keeps is what it sends to every page.
    msgspec.msgpack.encode(held if name != "upload" else None)
    parts = held if isinstance(held, tuple) else (held,)
    match name:
        case "checkbox" | "button":
            assert isinstance(held, bool)
        case "group" | "dropdown":
            assert held in ("a", "b")
        case "text" | "long text":
            assert isinstance(held, str)
        case "int" | "int slider":
            assert type(held) is int and 1 <= held <= 9
        case "float":
            assert type(held) is float and 1 <= held < float("inf")
        case "slider":
            assert type(held) is float and -1e-4 <= held <= 10 + 1e-4
        case "free int":
            assert type(held) is int and abs(held) <= 2**53
        case "free float" | "two" | "three":
            assert all(type(part) is float and abs(part) < float("inf") for part in parts)
            assert len(parts) == {"two": 2, "three": 3}.get(name, 1)
        case "several" | "colour" | "see-through":
            assert all(type(part) is int and 0 <= part <= 255 for part in parts)
            assert len(parts) == {"several": 2, "colour": 3, "see-through": 4}[name]


@pytest.mark.parametrize(
    ("name", "claimed", "held"),
    [
        ("checkbox", True, True),
        ("group", "b", "b"),
        ("dropdown", "b", "b"),
        ("text", "é" * LONGEST_LINE, "é" * LONGEST_LINE),
        ("long text", "{\n}", "{\n}"),
        ("int", 9, 9),
        ("int", 5.0, 5),  # a browser has one kind of number
        ("free int", -(2**53), -(2**53)),
        ("free float", 1e300, 1e300),
        ("slider", 10, 10.0),
        ("slider", 10.000000001, 10.000000001),  # a browser's arithmetic
        ("two", [-1, 2.5], (-1.0, 2.5)),
    ],
)
def test_what_a_control_can_hold_is_taken(controls, attacker, name, claimed, held):
    say(attacker, claim(controls[name], claimed))
    until(lambda: controls[name].value == held, f"{held!r}", seen=lambda: controls[name].value)


@pytest.mark.parametrize(
    ("name", "claimed", "sentence"),
    [
        ("slider", 10.1, "The slider goes from 0 to 10."),
        ("int", 0, "The int goes from 1 to 9."),
        ("float", 0.5, "The float is at least 1."),
        ("two", [1.0], "The two has 2 numbers."),
        ("several", [3, 4], "The several cannot be set from a page."),
        ("colour", [0, 255, 7], "The colour cannot be set from a page."),
        ("dropdown", "c", "That is not one of the choices for pick."),
        ("text", "a\nb", "The text takes one line of text."),
        ("text", "x" * (LONGEST_LINE + 1), "The text takes at most 10000 characters, not 10001."),
    ],
)
def test_the_page_that_sent_it_is_told_and_shown_the_true_value(
    gated_server, controls, hands_off, caplog, name, claimed, sentence
):
    control = controls[name]
    told: list[dict] = []
    with caplog.at_level(logging.WARNING), client(gated_server) as connection:
        say(connection, claim(control, claimed))

        def shown() -> bool:
            frame = connection.recv(timeout=30)
            assert isinstance(frame, bytes)
            told.extend(messages_in(frame))
            kinds = [message["type"] for message in told]
            if "NotificationShowMessage" not in kinds:
                return False
            later = told[kinds.index("NotificationShowMessage") :]
            return any(m.get("uuid") == element_id(control) and "value" in m["updates"] for m in later)

        until(shown, "the notice")
    value = control.value
    values = [m["updates"]["value"] for m in told if m.get("uuid") == element_id(control) and "updates" in m]
    assert values[-1] == (list(value) if isinstance(value, tuple) else value)
    bodies = [m["props"]["body"] for m in told if m["type"] == "NotificationShowMessage"]
    assert bodies == [sentence]


def test_what_is_typed_on_the_way_to_a_number_is_not_held_against_it(gated_server, monkeypatch):
    """12 is typed as 1, then 12: a correction that comes in between would take the 1 away."""
    monkeypatch.setattr(page_guard, "HANDS_OFF", 0.2)
    number = gated_server.server.gui.add_number("Steps", 50, min=10, max=99)
    with client(gated_server) as connection:
        say(connection, claim(number, 1))
        say(connection, claim(number, 12))
        until(lambda: number.value == 12, "the number")
        seen: list[str] = []
        with pytest.raises(TimeoutError):
            while True:
                frame = connection.recv(timeout=0.6)
                assert isinstance(frame, bytes)
                seen += [message["type"] for message in messages_in(frame)]
    assert "NotificationShowMessage" not in seen
    number.remove()


# Other kinds of messages --------------------------------------------------------------------------


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    "change",
    [
        {"position": (NAN, 0.0, 0.0)},
        {"look_at": (0.0, INF, 0.0)},
        {"up_direction": (0.0, 0.0, 1e200)},
        {"wxyz": (0.0, 0.0, 0.0, 0.0)},
        {"fov": 0.0},
        {"fov": NAN},
        {"image_width": -1},
        {"image_height": 10**9},
        {"near": -INF},
    ],
    ids=str,
)
def test_a_camera_that_cannot_be_is_dropped_and_the_page_stays(gated_server, bystander, change):
    with client(gated_server) as connection:
        known = {
            number: one.camera.position.copy() for number, one in gated_server.server.get_clients().items()
        }
        say(connection, {**CAMERA, "position": (7.0, 7.0, 7.0), **change})
        caught_up(gated_server, connection)
        for number, one in gated_server.server.get_clients().items():
            assert (one.camera.position == known[number]).all()
    bystander()


def test_a_gizmo_goes_nowhere_that_is_no_place(gated_server, bystander):
    gizmo = gated_server.server.scene.add_transform_controls("/gizmo")
    update = {"type": "TransformControlsUpdateMessage", "name": "/gizmo", "owner": gizmo._impl.api._owner_id}
    with client(gated_server) as connection:
        for wxyz, position in (
            ((1.0, 0.0, 0.0, 0.0), (NAN, 0.0, 0.0)),
            ((NAN, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
            ((0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
        ):
            say(connection, {**update, "wxyz": wxyz, "position": position})
        caught_up(gated_server, connection)
        assert tuple(gizmo.position) == (0.0, 0.0, 0.0)
        say(connection, {**update, "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 2.0, 3.0)})
        until(lambda: tuple(gizmo.position) == (1.0, 2.0, 3.0), "the gizmo's place")
    gizmo.remove()
    bystander()


@pytest.mark.parametrize("item", [b"\xc0", b"\x90", b"\x80", b"\xa0", b"\x01"], ids=repr)
def test_a_large_message_of_tiny_objects_is_not_taken_apart(gated_server, bystander, item):
    with client(gated_server) as connection:
        connection.send(b"\xdd" + (20_000_000).to_bytes(4, "big") + item * 20_000_000)
        assert close_code(connection) == 1009
    bystander()


def test_a_page_that_floods_is_slowed_then_let_go_and_the_others_go_on(gated_server, bystander, monkeypatch):
    monkeypatch.setattr(page_guard, "PATIENCE", 0.5)
    slider = gated_server.server.gui.add_slider("x", 0, 1000, 1, 0)
    gone = threading.Event()

    def flood() -> None:
        with client(gated_server) as connection, contextlib.suppress(ConnectionClosed):
            for number in itertools.count():
                say(connection, claim(slider, number % 1000))
        gone.set()

    thread = threading.Thread(target=flood)
    thread.start()
    until(lambda: slider.value > 0, "the flood")
    while not gone.is_set():
        bystander()
    thread.join()
    bystander()
    slider.remove()
