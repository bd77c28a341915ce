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


HIDDEN_SECONDS = 2.0
"""Minimum interval of drawings, in seconds, of a part that no page shows. The part is still drawn, so that it
is neither empty nor long out of date when a page opens it."""


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
        """Record a drawing with this key and this urgent value."""
        self._drawn = key, urgent, self._clock()

    def is_due(self, key: object, urgent: object = None, hidden: bool = False) -> bool:
        """Whether to draw now; if so, this records the drawing as `drawn` does.

        Args:
            hidden: Whether no page shows the thing: then nothing is urgent, and the minimum interval is
                `HIDDEN_SECONDS`.
        """
        if self._drawn is not None:
            drawn, was_urgent, at = self._drawn
            is_early = self._clock() - at < (HIDDEN_SECONDS if hidden else self._every)
            if (hidden or urgent == was_urgent) and (key == drawn or is_early):
                return False
        self.drawn(key, urgent)
        return True


class Parts(Generic[View]):
    """The parts of a page, in drawing order."""

    def __init__(self, parts: Iterable[PagePart[View]], clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._parts: list[tuple[PagePart[View], DrawThrottle, Callable[[View], bool]]] = []
        self._owners: dict[type[Command], PagePart[View]] = {}
        for part in parts:
            self.add(part)

    def add(self, part: PagePart[View], is_shown: Callable[[View], bool] = lambda view: True) -> None:
        """Add a part, which is drawn after the others.

        Args:
            is_shown: Returns whether a page may show the part. A part that no page shows is drawn rarely,
                since each drawing is sent to every browser.
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
        parts = [(part, is_due, not is_shown(view)) for part, is_due, is_shown in self._parts]
        due = [is_due.is_due(part.key(view), part.urgent(view), hidden) for part, is_due, hidden in parts]
        in_step = [part.of_the_moment and not hidden for part, _, hidden in parts]
        together = any(now and both for now, both in zip(due, in_step, strict=True))
        for now, both, (part, is_due, _) in zip(due, in_step, parts, strict=True):
            if now or (together and both):
                is_due.drawn(part.key(view), part.urgent(view))
                part.draw(view)
