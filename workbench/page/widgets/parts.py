"""Parts of a page, each redrawn when its content has changed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import ClassVar, Generic, TypeVar

import viser

from workbench.page.command import Command, Refused
from workbench.page.widgets.visitors import Done, Visitor

Clock = Callable[[], float]
"""Returns seconds: `time.monotonic`, or a test's clock. All parts of a page share one."""
View = TypeVar("View", contravariant=True)
BEFORE_FOLD_VALUE = " \N{MIDDLE DOT} "
"""Separates a folder's name from its value; the scripts (``panels.js``) find folders by the name."""


class PagePart(Generic[View]):
    """One part of a page, drawn from an immutable view.

    It is redrawn when its `key` changes, at most once per `every` seconds, and at once when `urgent` changes. By default
    every view is drawn: viser does not send equal values (``tests/page/test_assigning.py``), so a part needs a key only if
    its content is expensive to make.
    """

    every: ClassVar[float] = 0.0
    """Minimum interval of drawings in seconds."""
    does: tuple[type[Command], ...] = ()
    """Commands that this part carries out."""
    of_the_moment: ClassVar[bool] = False
    """Whether it shows numbers of the shown moment. Such parts are drawn together, from one view: with individual rates a
    page would show several moments at once while a task plays."""

    def key(self, view: View) -> object:
        """Key of the content that the part shows; equal keys mean equal drawings."""
        return object()

    def urgent(self, view: View) -> object:
        """Value that the user waits for; a change is drawn at once."""
        return None

    def draw(self, view: View) -> None:
        raise NotImplementedError

    def do(self, command: Command, visitor: Visitor) -> Done:
        """Carry out a command in `does`. Runs on the loop (`machine.loop`), and must not block. Raises `Refused`."""
        raise NotImplementedError


def name_fold(folder: viser.GuiFolderHandle, name: str, value: str) -> None:
    """Show a value next to a folder's name, so that a user sees the value without unfolding the folder."""
    folder.label = f"{name}{BEFORE_FOLD_VALUE}{value}" if value else name


class DrawThrottle:
    """Decides when to redraw one thing.

    Args:
        every: Minimum interval of drawings in seconds.
        clock: Clock of the page.
    """

    def __init__(self, every: float, clock: Clock = time.monotonic) -> None:
        self._every, self._clock = every, clock
        self._drawn: tuple[object, object, float] | None = None
        """Key, urgent value and time of the last drawing."""

    def drawn(self, key: object, urgent: object = None) -> None:
        """Store this as drawn."""
        self._drawn = key, urgent, self._clock()

    def is_due(self, key: object, urgent: object = None) -> bool:
        """Whether to draw now; if so, store this as drawn."""
        if self._drawn is not None:
            drawn, was_urgent, at = self._drawn
            if urgent == was_urgent and (key == drawn or self._clock() - at < self._every):
                return False
        self.drawn(key, urgent)
        return True


class Parts(Generic[View]):
    """The parts of a page, in drawing order."""

    def __init__(self, parts: Iterable[PagePart[View]], clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._parts: list[tuple[PagePart[View], DrawThrottle, Callable[[], bool]]] = []
        self._owners: dict[type[Command], PagePart[View]] = {}
        for part in parts:
            self.add(part)

    def add(self, part: PagePart[View], is_shown: Callable[[], bool] = lambda: True) -> None:
        """Add a part, which is drawn after the others.

        Args:
            is_shown: Whether a page may show the part. It is not drawn otherwise, since every browser would receive it.
        """
        self._parts.append((part, DrawThrottle(part.every, self._clock), is_shown))
        for kind in part.does:
            assert kind not in self._owners, f"two parts do {kind.__name__}"
            self._owners[kind] = part

    @property
    def does(self) -> frozenset[type[Command]]:
        """Commands that these parts carry out."""
        return frozenset(self._owners)

    def do(self, command: Command, visitor: Visitor) -> Done:
        """Let the part that has the command in `does` carry it out. Raises `Refused`, also if no part has the
        command."""
        owner = self._owners.get(type(command))
        if owner is None:
            raise Refused(f"Not on this page: {command.help()}.")
        return owner.do(command, visitor)

    def draw(self, view: View) -> None:
        shown = [(part, is_due) for part, is_due, is_shown in self._parts if is_shown()]
        due = [is_due.is_due(part.key(view), part.urgent(view)) for part, is_due in shown]
        together = any(now and part.of_the_moment for now, (part, _) in zip(due, shown, strict=True))
        for now, (part, is_due) in zip(due, shown, strict=True):
            if now or (together and part.of_the_moment):
                is_due.drawn(part.key(view), part.urgent(view))
                part.draw(view)
