"""Notes that the core adds to errors, and refusals of the core that a task has caught."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from traceback import extract_tb
from typing import Any, Literal

from workbench.machine.library_files import is_installed

Place = tuple[str, int, str]
"""File, line, and the name of the function."""
_MAX_REFUSALS = 3
"""Maximum number of refusals that are remembered in one call: each keeps its frames alive."""
_MAX_CHARACTERS = 400


class ErrorNote(str):
    """A fact about an error. Python prints it below the error.

    ``before``: the note is about an earlier error. ``place``: the line at fault, if the traceback has no line
    of the author's code.
    """

    before: bool
    place: Place | None

    def __new__(cls, text: str, place: Place | None = None, before: bool = False) -> ErrorNote:
        note = super().__new__(cls, text)
        note.place, note.before = place, before
        return note


def notes_of(error: BaseException) -> list[str]:
    """All notes of an error, not only the core's."""
    return [note for note in getattr(error, "__notes__", ()) if isinstance(note, str)]


class CoreRefusal(Exception):
    """The batched core refuses a call or a value of a task.

    The running `AuthorCall` stores the refusal: the task may catch the error, and later fail because of it.
    `place` is the line at fault, if the traceback does not show it.
    """

    def __init__(self, *args: object, place: Place | None = None) -> None:
        super().__init__(*args)
        self.place = place
        _running.remember(self)


class RefusedCall(CoreRefusal, RuntimeError):
    """A call that the core refuses in the present state, or for this object."""


class RefusedValue(CoreRefusal, ValueError):
    """A value that the core refuses."""


class RefusedMember(CoreRefusal, NotImplementedError):
    """A member that the batched simulation does not have."""


class WrongAction(ValueError):
    """An action that does not fit the task. `problem` is a sentence without its subject, "the action"."""

    def __init__(self, problem: str) -> None:
        super().__init__(f"the action {problem}")
        self.problem = problem


class AuthorCall:
    """Context around a call of the author's code. An error that leaves the context gets a note for each
    refusal of the core that the task caught. Can be nested."""

    def __enter__(self) -> None:
        self._first = len(_running.refusals)
        _running.depth += 1

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> Literal[False]:
        _running.depth -= 1
        if error is not None:
            known = [*chain_of(error, suppressed=True)]
            for refusal in _running.refusals[self._first :]:
                note = None if refusal in known else _caught_note(refusal)
                if note is not None and note not in notes_of(error):
                    error.add_note(note)
        if _running.depth == 0:
            _running.refusals.clear()  # they keep the frames of the call alive
        return False


class _Running(threading.local):
    """Depth of this thread's running `AuthorCall`s, and the refusals during them."""

    def __init__(self) -> None:
        self.depth = 0
        self.refusals: list[CoreRefusal] = []

    def remember(self, refusal: CoreRefusal) -> None:
        if self.depth and len(self.refusals) < _MAX_REFUSALS:
            self.refusals.append(refusal)


_running = _Running()


def chain_of(error: BaseException, suppressed: bool = False) -> Iterator[BaseException]:
    """The error, its cause, the cause of that, and so on.

    Ends at a refusal of the core, whose text already explains its cause.

    Args:
        suppressed: include what ``raise ... from None`` hides.
    """
    seen: set[int] = set()
    link: BaseException | None = error
    while link is not None and id(link) not in seen:
        seen.add(id(link))
        yield link
        if isinstance(link, CoreRefusal):
            return
        hides = link.__suppress_context__ and not suppressed
        link = link.__cause__ or (None if hides else link.__context__)


def _caught_note(refusal: CoreRefusal) -> ErrorNote | None:
    """Note about a caught refusal; None if the refusal was never raised."""
    frames = [(frame.filename, frame.lineno or 1, frame.name) for frame in extract_tb(refusal.__traceback__)]
    if not frames:
        return None
    caught = frames[0]
    at = refusal.place or next((place for place in reversed(frames) if not is_installed(place[0])), caught)
    text = " ".join(str(refusal).split())
    text = text if len(text) <= _MAX_CHARACTERS else text[: _MAX_CHARACTERS - 1] + "…"
    where = "in the same line" if at[:2] == caught[:2] else f"at {_text_of(caught)}"
    return ErrorNote(
        f"Before this, the workbench refused {_text_of(at)}, and the task caught the error {where}: {text}",
        at,
        before=True,
    )


def _text_of(place: Place) -> str:
    file, line, function = place
    return f"{Path(file).name}:{line} in {function}"
