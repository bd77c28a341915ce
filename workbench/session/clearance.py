"""Whether code that a recording names or holds may run: every way to it goes through `Clearances`, and is asked once.

A recording is somebody else's file until its seal says that it was made here. What it names is opened without a question
if it is an id of an installed package, a file that a person named (on the command line, or that is open live), or the file
that this installation had open when it recorded. Of anything else the texts are read, not run, and a person is asked about
these very texts; the answer is kept by what they say. What was agreed to is what runs, whatever becomes of the file.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from workbench.authoring.reference import TaskName
from workbench.authoring.task_content import CannotRead, TaskContent, content_of_texts, read_content
from workbench.authoring.trust import TrustStore
from workbench.machine.terminal_text import short_line
from workbench.recording.episode import EpisodeInfo
from workbench.recording.made_here import MadeHere, made_here
from workbench.session.recorded_text import NoText, below_one_folder

SHORT_HASH = 12
LONGEST = 400
"""Characters of a name that is shown."""


class Answer(Enum):
    NO = "no"
    NONE = "none"
    """Neither this nor any other of those that are asked about together."""
    ONCE = "once"
    """Until the program ends."""
    ALWAYS = "always"


@dataclass(frozen=True)
class Question:
    """What a person is to be asked. Texts out of recordings are printable, and not escaped."""

    file: str
    """What would run: a path, or the name of a file that a recording holds."""
    task: str
    """Of the recording that wants it."""
    recorded_text: bool
    """The text is the one that the recording holds, and not a file on the disk."""
    hash: str
    """The first digits."""
    modules: tuple[str, ...]
    """Further files that would run."""
    unseen: tuple[str, ...]
    changed: bool
    """Another text of this file was trusted before."""
    more: int = 0
    """Questions that follow this one."""


class NotCleared(Exception):
    """Code is not to run; the message is the reason, `question` what would have to be agreed to, if that would help."""

    def __init__(self, why: str, question: Question | None = None) -> None:
        super().__init__(why)
        self.question = question


class NotTrusted(Exception):
    """Nothing was run, because there is code that nobody agreed to."""

    def __init__(self, questions: Sequence[Question]) -> None:
        super().__init__("; ".join(map(in_words, questions)))
        self.questions = tuple(questions)


Ask = Callable[[Question, Callable[[], bool]], Answer]
"""Puts a question to a person and waits for the answer; gives up, which is a no, when its second argument says so."""


@dataclass(frozen=True)
class Wanted:
    """Something that would run."""

    reference: TaskName
    """What is opened; not looked at where it is the recorded text."""
    info: EpisodeInfo
    """Of the recording that wants it."""
    recorded_text: bool = False


class Clearances:
    """
    Args:
        named: The files that a person named: on the command line, or by having them open live.
        ask: Puts a question to a person; None where there is nobody: the answer is no then.
        all_trusted: Every answer is yes, for this run (``--trust``).
    """

    def __init__(
        self,
        named: Callable[[], Iterable[Path]] = tuple,
        ask: Ask | None = None,
        all_trusted: bool = False,
    ) -> None:
        self._named, self._ask, self._all_trusted = named, ask, all_trusted
        self._store = TrustStore()

    @property
    def asks(self) -> bool:
        """Whether there is a person to ask."""
        return self._ask is not None

    def clear(self, wanted: Wanted, stopped: Callable[[], bool] = lambda: False) -> TaskName:
        """What may be opened for it; asks if need be, and waits for the answer.

        Raises:
            NotCleared: nothing may, and why.
        """
        (cleared,) = self.clear_all([wanted], stopped)
        if isinstance(cleared, NotCleared):
            raise cleared
        return cleared

    def clear_all(
        self, wanted: Sequence[Wanted], stopped: Callable[[], bool] = lambda: False
    ) -> list[TaskName | NotCleared]:
        """The same for several; each text is asked about once."""
        found = [self._without_asking(one) for one in wanted]
        open_ones = {one.hash: one for one in found if isinstance(one, TaskContent)}
        refused: dict[str, NotCleared] = {}
        none_of_them = False
        for place, (hash, content) in enumerate(open_ones.items()):
            about = next(
                one for one, its in zip(wanted, found) if isinstance(its, TaskContent) and its.hash == hash
            )
            question = replace(self._question(about, content), more=len(open_ones) - place - 1)
            answer = (
                Answer.NO if none_of_them or self._ask is None or stopped() else self._ask(question, stopped)
            )
            none_of_them = none_of_them or answer is Answer.NONE
            if answer in (Answer.NO, Answer.NONE):
                refused[hash] = NotCleared(f"{in_words(question)} is not trusted", question)
            elif answer is Answer.ALWAYS:
                self._store.trust(content)
            else:
                self._store.trust_once(content)
        cleared: list[TaskName | NotCleared] = []
        for one, its in zip(wanted, found):
            if not isinstance(its, TaskContent):
                cleared.append(its)
            elif its.hash in refused:
                cleared.append(refused[its.hash])
            else:
                cleared.append(_approved(one, its))
        return cleared

    def why_not_its_arguments(self, info: EpisodeInfo, made: MadeHere | None = None) -> str | None:
        """Why an env cannot be made as this recording was; None where it can: arguments from elsewhere name no files."""
        if self._all_trusted or (made or made_here(info)) is not MadeHere.NO:
            return None
        named = [_printable(text) for text in files_named(info)]
        if not named:
            return None
        return f"a recording of {_printable(info.task)} that was not made here names files for its env to read ({', '.join(named[:3])})"

    def _without_asking(self, wanted: Wanted) -> TaskName | NotCleared | TaskContent:
        """What may be opened; or the texts that have to be asked about."""
        made = made_here(wanted.info)
        if (why := self.why_not_its_arguments(wanted.info, made)) is not None:
            return NotCleared(why)
        if wanted.recorded_text:
            try:
                content = recorded_content(wanted.info)
            except NoText as error:
                return NotCleared(str(error))
            trusted = made is not MadeHere.NO
        else:
            reference = wanted.reference
            if isinstance(reference, str) or reference.file is None:
                return reference
            if made is MadeHere.CONTENT_AND_PLACE and reference.file == wanted.info.source_file:
                return str(reference)
            if _is_one_of(reference.file, self._named()):
                return str(reference)
            try:
                content = read_content(Path(reference.file))
            except CannotRead as error:
                return NotCleared(str(error))
            trusted = made is not MadeHere.NO and _as_recorded(content, wanted.info)
        if trusted or self._all_trusted or self._store.trusts(content):
            return _approved(wanted, content)
        return content

    def _question(self, wanted: Wanted, content: TaskContent) -> Question:
        return Question(
            _printable(content.main),
            _printable(wanted.info.task),
            wanted.recorded_text,
            content.hash[:SHORT_HASH],
            tuple(map(_printable, content.modules)),
            tuple(map(_printable, content.unseen)),
            not wanted.recorded_text and self._store.trusted_before(content),
        )


def files_named(info: EpisodeInfo) -> list[str]:
    """What in the arguments of a recording's env looks like a path: a task may open it, whatever it is."""
    found: list[str] = []
    waiting: list[Any] = [info.env_kwargs, info.reset_options, info.control_mode]
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict):
            waiting += [*value.keys(), *value.values()]
        elif isinstance(value, (list, tuple)):
            waiting += value
        elif isinstance(value, str) and _is_like_a_path(value):
            found.append(value)
    return found


def _is_like_a_path(text: str) -> bool:
    if "/" in text or "\\" in text or text.startswith("~"):
        return True
    try:
        return "." in text and os.path.lexists(text)
    except ValueError:  # a null byte
        return True


def recorded_content(info: EpisodeInfo) -> TaskContent:
    """The text that a recording holds.

    Raises:
        NoText: it holds none.
    """
    if not info.source or info.source_file is None:
        raise NoText("this recording does not hold the text of its task")
    return content_of_texts(*below_one_folder(info.source_file, info.source))


def _approved(wanted: Wanted, content: TaskContent) -> TaskName:
    if wanted.recorded_text or isinstance(wanted.reference, str):
        return wanted.reference
    return replace(wanted.reference, file=content.main, approved=content.texts)


def _as_recorded(content: TaskContent, info: EpisodeInfo) -> bool:
    """Whether a file says what the recording holds: then the seal speaks for it, wherever it lies."""
    try:
        return content.hash == recorded_content(info).hash
    except NoText:
        return False


def _printable(text: str) -> str:
    return short_line(text, LONGEST)


def _is_one_of(file: str, named: Iterable[Path]) -> bool:
    real = os.path.realpath(file)
    return any(os.path.realpath(one) == real for one in named)


def in_words(question: Question) -> str:
    """The code that a question is about, with its hash."""
    if question.recorded_text:
        return f"the text of {question.file} in recordings of {question.task} ({question.hash})"
    return f"{question.file} ({question.hash})"
