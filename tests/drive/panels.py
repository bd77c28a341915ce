"""Reads and presses the controls of a page without a browser. Only this file uses viser's private names.

A control is found by its label, a part of our HTML by its command. A press is a command; it returns when everything
that it started on viser's threads is done. Only what a page offers can be pressed.
"""

# pyright: reportAttributeAccessIssue=false, reportPrivateUsage=false

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import viser
from markupsafe import escape
from numpy.typing import NDArray
from viser._messages import CommandTriggerMessage, GuiSetPanelCollapsedMessage

from tests.drive.charts import Chart, charts_in
from tests.drive.own_controls import Controls, SeenButton, SeenField
from workbench.commands import COMMANDS
from workbench.machine.loop import do as on_loop
from workbench.machine.loop import result_of
from workbench.page.command import Command, Refused
from workbench.page.door.gated_server import GatedServer
from workbench.page.widgets.parts import Parts
from workbench.page.widgets.templates import asks
from workbench.page.widgets.visitors import PATH, Visitor, Visitors

Kind = Literal["button", "field"]
"""Kind of an input: a button and a field may have the same label."""
_NOT_SEEN = {"order", "visible", "container_uuid", "parent_uuid", "_tab_container_ids"}
"""Properties of a part that are not visible on the page."""
_Roots = list[tuple[Any, bool]]
"""Containers, and whether each is visible."""


class Clock:
    """A clock for a page's parts that only moves in `passes`."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now

    def passes(self, seconds: float = 60.0) -> None:
        self.now += seconds


@dataclass(eq=False)
class Client:
    """The client of a callback, with the few members that callbacks use."""

    client_id: int = 1
    notices: list[str] = field(default_factory=list)
    sent: list[str] = field(default_factory=list)
    """HTML that was sent to this page alone."""
    camera: Any = field(default_factory=lambda: SimpleNamespace(wxyz=(1.0, 0.0, 0.0, 0.0)))

    def add_notification(self, title: str, body: str, **_: object) -> None:
        self.notices.append(body)

    @property
    def gui(self) -> Any:
        return SimpleNamespace(add_html=self._add_html)

    def _add_html(self, html: str) -> Any:
        self.sent.append(html)
        return SimpleNamespace(remove=lambda: None)


class _Threads:
    """Wraps viser's thread pool, and waits for the jobs that were submitted."""

    def __init__(self, pool: Any) -> None:
        self._pool = pool
        self._begun: list[Future[Any]] = []

    def submit(self, call: Callable[..., Any], *args: Any) -> Future[Any]:
        future = self._pool.submit(call, *args)
        self._begun.append(future)
        return future

    def shutdown(self, *args: Any, **named: Any) -> None:
        self._pool.shutdown(*args, **named)

    def wait(self) -> None:
        begun, self._begun = self._begun, []
        for future in begun:
            future.result(timeout=60)


def held_by(server: viser.ViserServer) -> dict[str, int]:
    """Number of objects of each kind that the server holds for its pages, after viser's garbage collection."""
    server._run_garbage_collector(force=True)
    gui, sockets = server.gui, server._websock_server
    return {
        "inputs": len(gui._gui_input_handle_from_uuid),
        "containers": len(gui._container_handle_from_uuid),
        "panels": len(gui._panel_handle_from_uuid),
        "commands": len(gui._command_handle_from_uuid),
        "nodes": len(server.scene._handle_from_node_name),
        "clicks": len(server.scene._scene_pointer_cb),
        "messages": len(sockets._broadcast_buffer.message_from_id),
        "pages": len(sockets._client_state_from_id),
    }


def drop_viser(gated_server: GatedServer) -> None:
    """Abort viser's connection of each open page; the command channel stays."""
    listening: Any = gated_server._gated._serving.server

    def drop() -> None:
        for connection in list(listening.connections):
            if not connection.request.path.startswith(PATH):
                connection.transport.abort()

    listening.get_loop().call_soon_threadsafe(drop)


def forget_what_was_drawn(parts: Parts[Any]) -> None:
    """Force every part of a page to redraw with the next view."""
    for _, due, _ in parts._parts:
        due._drawn = None


def messages_sent(server: viser.ViserServer) -> int:
    """Number of messages that the server has broadcast to all pages."""
    return server._websock_server._broadcast_buffer.message_counter


def difference(before: dict[str, object], after: dict[str, object]) -> str:
    """Keys whose values differ, one per line; empty if none do."""
    keys = [key for key in {**before, **after} if before.get(key) != after.get(key)]
    return "\n".join(f"{key}: {before.get(key)!r:.300} -> {after.get(key)!r:.300}" for key in keys)


def inputs_of(gui: viser.GuiApi) -> list[Any]:
    """All inputs of a server's pages, or of one page."""
    return list(gui._gui_input_handle_from_uuid.values())


class Panels:
    """Everything that a server shows in its panels; `part` is one tab or folder."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.server = server
        self.client = Client()
        self._path: tuple[str, ...] = ()
        gui: Any = server.gui
        self._threads = _Threads(gui._thread_executor)
        gui._thread_executor = self._threads
        gui._resolve_client = lambda client_id: self.client
        self.visitor = Visitor("a page", self.client)  # type: ignore[arg-type]
        self.come_to(Visitors(server, COMMANDS))
        self.visitors.do = _unexpected_command

    def come_to(self, visitors: Visitors) -> None:
        """Join these visitors as an open page."""
        self.visitors = visitors
        visitors._by_name[self.visitor.name] = visitors._by_client[self.client.client_id] = self.visitor

    def part(self, label: str) -> Panels:
        """The tab or folder with this label."""
        part = object.__new__(Panels)
        part.__dict__.update(self.__dict__, _path=(*self._path, label))
        return part

    # --- what is shown ------------------------------------------------------------------------------

    def shows(self, name: str, kind: Kind | None = None) -> bool:
        """Whether a button or a field with this name is visible."""
        own = [one.text.strip() for one in self.buttons()] if kind != "field" else []
        own += [one.label for one in self.fields()] if kind != "button" else []
        return name in own

    @property
    def seen(self) -> bool:
        """Whether this part is visible once its tab is in front."""
        return any(seen for _, seen in self._roots())

    def html(self, mark: str = "") -> str:
        """The visible HTML that contains `mark`, such as a CSS class."""
        return "\n".join(handle.content for handle in self.htmls() if mark in handle.content)

    def htmls(self) -> list[viser.GuiHtmlHandle]:
        return self._of(viser.GuiHtmlHandle)

    def charts(self) -> list[Chart]:
        """The visible charts, from the top."""
        handles = sorted(self.htmls(), key=lambda handle: handle.order)
        return charts_in("".join(one.content for one in handles if 'class="wb-chart"' in one.content))

    def images(self) -> list[viser.GuiImageHandle]:
        return self._of(viser.GuiImageHandle)

    def folders(self) -> list[str]:
        """Labels of the folders and tabs, in the order of the page."""
        containers = sorted(_containers(self._roots()), key=lambda one: getattr(one[0], "order", 0.0))
        return [label for one, seen in containers if seen and (label := _label_of(one)) is not None]

    def commands(self) -> list[str]:
        """Labels of the palette's commands."""
        return list(self._commands())

    def takes(self, label: str) -> bool:
        """Whether a command of the palette can be chosen now."""
        return not self._commands()[label][1].disabled

    def is_folded(self, label: str) -> bool:
        """Whether the page last collapsed the panel that has a tab with this label."""
        panels = self.server.gui._panel_handle_from_uuid
        (uuid,) = (uuid for uuid, one in panels.items() if label in map(_label_of, one._tab_handles))
        messages = list(self.server._websock_server._broadcast_buffer.message_from_id.values())
        sent = [m for m in messages if isinstance(m, GuiSetPanelCollapsedMessage) and m.uuid == uuid]
        return bool(sent) and sent[-1].collapsed

    def bodies(self, word: str) -> list[viser.BatchedMeshHandle]:
        """The meshes in the 3-D view with `word` in their names."""
        return [node for node in self.nodes(word) if hasattr(node, "batched_positions")]

    def labels(self) -> list[str]:
        """Texts of the visible labels in the 3-D view."""
        return [node.text for node in self.nodes("") if isinstance(node, viser.LabelHandle) and node.visible]

    def nodes(self, word: str) -> list[Any]:
        """The nodes of the 3-D view with `word` in their names."""
        nodes = self.server.scene._handle_from_node_name
        return [handle for name, handle in sorted(nodes.items()) if word in name]

    def everything(self) -> dict[str, object]:
        """Everything visible, by its place on the page, to compare with another time."""

        def plain(value: object) -> object:
            if isinstance(value, bytes):
                return hash(value)
            if isinstance(value, np.ndarray):
                return value.shape, hash(value.tobytes())
            if isinstance(value, str):
                return value
            if isinstance(value, (tuple, list)):
                return tuple(map(plain, value))
            return value if isinstance(value, (int, float, bool, type(None))) else repr(value)

        def of(handle: Any) -> dict[str, object]:
            props = vars(handle._impl.props if hasattr(handle._impl, "props") else handle._impl.message.props)
            return {name: plain(value) for name, value in props.items() if name not in _NOT_SEEN}

        seen: dict[str, object] = {}
        for child, is_seen in self._walk(self._roots()):
            label = getattr(child, "label", None) or ""
            if is_seen:
                value = plain(getattr(child._impl, "value", None))
                key = f"{type(child).__name__} {label if isinstance(label, str) else ''}"
                seen[f"{key} {sum(one.startswith(key) for one in seen)}"] = value, of(child)
        for node in self.nodes(""):
            if node.name and getattr(node, "visible", True):
                seen[f"in the view: {node.name}"] = plain(node.position), plain(node.wxyz), of(node)

        for label, (_, command) in self._commands().items():
            seen[f"command {label}"] = of(command)
        return seen

    # --- what a user does ------------------------------------------------------------------------

    def press(self, name: str) -> None:
        """Press the button with this text."""
        button = self.button(name)
        assert button.command is not None, f"no page offers {name}"
        self.do(button.command)

    def type(self, label: str, value: object, at: int = 0) -> None:
        """Type into one of our own fields and leave it; `at` is the index in a row of fields."""
        self._enter(self.field(label), value, at)

    def typed(self, label: str) -> Any:
        """What one of our own fields shows."""
        return self.field(label).value

    def field(self, label: str) -> SeenField:
        """The one visible input of ours with this label."""
        found = [one for one in self.fields() if one.label == label]
        assert len(found) == 1, (label, [one.label for one in self.fields()])
        return found[0]

    def fields(self) -> list[SeenField]:
        """Our own visible inputs."""
        return self._own().fields

    def buttons(self) -> list[SeenButton]:
        """Our own buttons, disabled ones too."""
        return self._own().buttons

    def button(self, text: str) -> SeenButton:
        """The one button of ours with this text."""
        (found,) = (one for one in self.buttons() if one.text.strip() == text)
        return found

    def _own(self) -> Controls:
        return Controls("\n".join(one.content for one in self.htmls()))

    def _enter(self, field: SeenField, value: Any, at: int = 0) -> None:
        assert not field.off, f"no page offers {field.label}"
        try:
            command = field.command(value, at)
        except Refused as reason:
            self.client.notices.append(str(reason))
        else:
            self.do(command)

    def presses(self, command: Command) -> bool:
        """Whether a visible part sends this command."""
        return f"{escape(asks(command))}" in self.html("data-do")

    def ask(self, command: Command) -> None:
        """Press the part of our HTML that sends this command."""
        assert self.presses(command), f"no page offers {command}"
        self.do(command)

    def do(self, command: Command) -> None:
        """Run this command, as a key or a script does; a refusal is added to the notices."""
        try:
            result_of(self.visitors._carry_out(command, self.visitor))
        except Refused as reason:
            self.client.notices.append(str(reason))
        self._threads.wait()

    def set(self, name: str, value: object) -> None:
        """Move a slider, choose from a list, tick a box, or type a text or a number."""
        self._enter(self.field(name), value)

    def command(self, label: str) -> None:
        """Choose a command in the palette."""
        uuid, handle = self._commands()[label]
        assert not handle.disabled, f"{label} is greyed"
        self._handled(self.server.gui._handle_command_trigger, CommandTriggerMessage(uuid))

    def click_view(self, origin: NDArray, direction: NDArray) -> None:
        """Click into the 3-D view: a ray from `origin` (3,) along `direction` (3,)."""
        ray: Any = tuple(origin.tolist()), tuple(direction.tolist())
        event = viser.SceneClickEvent(self.client, self.client.client_id, *ray, (0.5, 0.5), None)  # type: ignore[arg-type]
        for entry in list(self.server.scene._scene_pointer_cb):
            asyncio.run(entry.callback(event))  # type: ignore[arg-type]
        on_loop(lambda: None)  # the page handles the click on its loop

    def turn(self, gizmo: str, pose: np.ndarray, phase: str = "update") -> None:
        """Drag the handles of this name to a pose (7,) in the view."""
        (handle,) = self.nodes(gizmo)
        target = SimpleNamespace(position=pose[:3], wxyz=pose[3:])
        event = SimpleNamespace(
            client=self.client, client_id=self.client.client_id, phase=phase, target=target
        )
        for callback in handle._impl_aux.update_cb:
            asyncio.run_coroutine_threadsafe(callback(event), self.server.gui._event_loop).result(60)
        on_loop(lambda: None)

    def settle(self) -> None:
        """Wait until viser's event loop and the jobs that it started are done."""

        async def nothing() -> None: ...

        asyncio.run_coroutine_threadsafe(nothing(), self.server.gui._event_loop).result(60)
        self._threads.wait()

    # --- viser's own -------------------------------------------------------------------------------

    def _handled(self, handler: Callable[..., Any], message: object) -> None:
        loop = self.server.gui._event_loop
        asyncio.run_coroutine_threadsafe(handler(self.client.client_id, message), loop).result(60)
        self._threads.wait()

    def _commands(self) -> dict[str, tuple[str, viser.CommandHandle]]:
        commands = self.server.gui._command_handle_from_uuid
        return {handle.label: (uuid, handle) for uuid, handle in commands.items()}

    def _of(self, kind: type[Any], hidden: bool = False) -> list[Any]:
        there = self._walk(self._roots())
        return [handle for handle, seen in there if (seen or hidden) and isinstance(handle, kind)]

    def _roots(self) -> _Roots:
        gui = self.server.gui
        roots: _Roots = [(gui._container_handle_from_uuid["root"], True)]
        for panel in gui._panel_handle_from_uuid.values():
            roots += [(tab, panel.visible) for tab in panel._tab_handles]
        roots += [(modal, True) for modal in gui._modal_handle_from_uuid.values()]
        for label in self._path:
            roots = [(one, seen) for one, seen in _containers(roots) if _label_of(one) == label]
            assert roots, f"no tab or folder {label}"
        return roots

    def _walk(self, roots: _Roots) -> Iterator[tuple[Any, bool]]:
        for container, seen in _containers(roots):
            for child in list(container._children.values()):
                yield child, seen and child.visible


def _unexpected_command(command: Command, visitor: Visitor) -> None:
    raise AssertionError(f"the test has no handler for {command}")


def _containers(roots: _Roots) -> Iterator[tuple[Any, bool]]:
    for container, seen in roots:
        yield container, seen
        for child in list(container._children.values()):
            inner = [child] if hasattr(child, "_children") else getattr(child, "_tab_handles", [])
            yield from _containers([(one, seen and child.visible) for one in inner])


def _label_of(container: Any) -> str | None:
    return getattr(container, "_label", None) or getattr(container, "label", None)
