"""Whether code that a recording names or holds may run: every way to it goes through `Clearances`, and is asked once.

A recording is somebody else's file until its seal says that it was made here. What it names is opened without a question
if it is an id of an installed package, a file that a person named (on the command line, or that is open live), or the file
that this installation had open when it recorded. Of anything else the texts are read, not run, and a person is asked about
these very texts; the answer is kept by what they say. What was agreed to is what runs, whatever becomes of the file:
but where the file is to be followed, as by going live, its saves run too, and that is a question of its own.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from workbench.authoring.loading.reference import RecordedTask, TaskName, looks_like_file
from workbench.authoring.loading.task_content import CannotRead, TaskContent, read_content
from workbench.authoring.loading.trust import TrustStore
from workbench.jobs.from_recording import NoText, below_one_folder
from workbench.machine.text import short_line
from workbench.recording.episode.episode import EpisodeInfo
from workbench.recording.episode.made_here import MadeHere, made_here

SHORT_HASH = 12
LONGEST = 400
"""Characters of a name that is shown."""
FOLLOWED = (
    "From then on, for as long as it is open live, every save of this file and of the modules beside it runs without asking, "
    "whoever saves it, and Judge again takes the file as it is."
)
"""What going live means for a file that a recording names."""


class Consent(Enum):
    NO = "no"
    NONE = "none"
    """Neither this nor any other of those that are asked about together."""
    ONCE = "once"
    """Until the program ends."""
    ALWAYS = "always"


class Since(Enum):
    """What became of a file since another version of it and the files beside it was trusted."""

    SAME = "same"
    CHANGED = "changed"
    NEW = "new"


@dataclass(frozen=True)
class AskedFile:
    """One of the texts that would run."""

    name: str
    """The path of the task's own file; of a module as seen from there."""
    hash: str
    """The first digits of what ``sha256sum`` says of it."""
    text: str
    """As it is: whoever shows it has to escape it."""
    since: Since = Since.SAME


@dataclass(frozen=True)
class TrustQuestion:
    """What a person is to be asked. Texts out of recordings are printable, and not escaped."""

    task: str
    """Of the recording that wants it."""
    recorded_text: bool
    """The texts are those that the recording holds, and not files on the disk."""
    files: tuple[AskedFile, ...]
    """What would run; the task's own file first."""
    unseen: tuple[str, ...] = ()
    """What may run and is not among them."""
    computed: bool = False
    """The modules are all that lie beside the file, since it cannot be told which of them it imports."""
    trusted_before: bool = False
    """Another version of the same files was trusted; `AskedFile.since` says what changed, unless nothing is known of it."""
    gone: tuple[str, ...] = ()
    """Modules of that version that are not there any more."""
    followed: bool = False
    """Whatever is saved to these files runs from then on."""
    agreed: bool = False
    """These very texts may run already; that they are followed is new."""
    more: int = 0
    """Questions that follow this one."""

    @property
    def file(self) -> str:
        """A path, or the name of a file that a recording holds."""
        return self.files[0].name

    @property
    def hash(self) -> str:
        """Of the task's own file."""
        return self.files[0].hash

    @property
    def modules(self) -> tuple[AskedFile, ...]:
        """The files besides the task's own."""
        return self.files[1:]

    @property
    def nothing_known(self) -> bool:
        """What was trusted before is not known file by file."""
        return self.trusted_before and not self.gone and all(one.since is Since.SAME for one in self.files)


class NotCleared(Exception):
    """Code is not to run; the message is the reason, `question` what would have to be agreed to, if that would help.

    Where `trust_helps`, nobody is asked, but ``--trust`` agrees.
    """

    def __init__(self, why: str, question: TrustQuestion | None = None, trust_helps: bool = False) -> None:
        super().__init__(why)
        self.question, self.trust_helps = question, trust_helps


class NotTrusted(Exception):
    """Nothing was run, because there is code that nobody agreed to, or, for these `reasons`, without ``--trust``."""

    def __init__(self, questions: Sequence[TrustQuestion], reasons: Sequence[str] = ()) -> None:
        super().__init__("; ".join((*map(in_words, questions), *reasons)))
        self.questions, self.reasons = tuple(questions), tuple(reasons)


Ask = Callable[[TrustQuestion, Callable[[], bool]], Consent]
"""Puts a question to a person and waits for the answer; gives up, which is a no, when its second argument says so."""


@dataclass(frozen=True)
class CodeToRun:
    """Something that would run."""

    reference: TaskName
    """What is opened; not looked at where it is the recorded text."""
    info: EpisodeInfo
    """Of the recording that wants it."""
    recorded_text: bool = False
    followed: bool = False
    """What is saved to the file runs from then on."""


@dataclass(frozen=True)
class _Open:
    """Texts that a person has to be asked about."""

    content: TaskContent
    agreed: bool
    """They may run, but not be followed."""


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

    def clear(self, wanted: CodeToRun, stopped: Callable[[], bool] = lambda: False) -> TaskName:
        """What may be opened for it; asks if need be, and waits for the answer.

        Raises:
            NotCleared: nothing may, and why.
        """
        (cleared,) = self.clear_all([wanted], stopped)
        if isinstance(cleared, NotCleared):
            raise cleared
        return cleared

    def clear_all(
        self, wanted: Sequence[CodeToRun], stopped: Callable[[], bool] = lambda: False
    ) -> list[TaskName | NotCleared]:
        """The same for several; each text is asked about once."""
        found = [self._without_asking(one) for one in wanted]
        open_ones: dict[str, tuple[CodeToRun, _Open]] = {}
        for one, its in zip(wanted, found):
            if isinstance(its, _Open):
                open_ones.setdefault(its.content.hash, (one, its))
        refused: dict[str, NotCleared] = {}
        none_of_them = False
        for place, (hash, (about, its)) in enumerate(open_ones.items()):
            question = replace(self._question(about, its), more=len(open_ones) - place - 1)
            answer = (
                Consent.NO if none_of_them or self._ask is None or stopped() else self._ask(question, stopped)
            )
            none_of_them = none_of_them or answer is Consent.NONE
            if answer in (Consent.NO, Consent.NONE):
                refused[hash] = NotCleared(f"{in_words(question)} is not trusted", question)
            elif answer is Consent.ALWAYS:
                self._store.trust(its.content, about.followed)
            else:
                self._store.trust_once(its.content, about.followed)
        cleared: list[TaskName | NotCleared] = []
        for one, its in zip(wanted, found):
            if not isinstance(its, _Open):
                cleared.append(its)
            elif its.content.hash in refused:
                cleared.append(refused[its.content.hash])
            elif not one.recorded_text and not _is_as_it_was(its.content):
                cleared.append(
                    NotCleared(
                        f"the code of {_printable(its.content.main)} was changed while you were asked about it; try it again"
                    )
                )
            else:
                cleared.append(_approved(one, its.content))
        return cleared

    def why_not_its_arguments(self, info: EpisodeInfo, made: MadeHere | None = None) -> str | None:
        """Why an env cannot be made as this recording was; None where it can: arguments from elsewhere name no files."""
        if self._all_trusted or (made or made_here(info)) is not MadeHere.NO:
            return None
        named = [_printable(text) for text in files_named(info)]
        if not named:
            return None
        return (
            f"a recording of {_printable(info.task)} that was not made here names files for its env to read "
            f"({', '.join(named[:3])}), which it may only with --trust on the command line"
        )

    def _without_asking(self, wanted: CodeToRun) -> TaskName | NotCleared | _Open:
        """What may be opened; or the texts that have to be asked about."""
        made = made_here(wanted.info)
        if (why := self.why_not_its_arguments(wanted.info, made)) is not None:
            return NotCleared(why, trust_helps=True)
        if wanted.recorded_text:
            try:
                content = recorded_content(wanted.info)
            except NoText as error:
                return NotCleared(str(error))
            trusted = made is not MadeHere.NO
        else:
            reference = wanted.reference
            if isinstance(reference, str):
                return reference
            if reference.file is None:
                return _registered(reference)
            if made is MadeHere.CONTENT_AND_PLACE and reference.file == wanted.info.source_file:
                return str(reference)
            if _is_one_of(reference.file, self._named()):
                return str(reference)
            try:
                content = read_content(Path(reference.file))
            except CannotRead as error:
                return NotCleared(str(error))
            trusted = made is not MadeHere.NO and _as_recorded(content, wanted.info)
        agreed = trusted or self._all_trusted or self._store.trusts(content)
        if agreed and (not wanted.followed or self._all_trusted or self._store.follows(content)):
            return _approved(wanted, content)
        return _Open(content, agreed)

    def _question(self, wanted: CodeToRun, its: _Open) -> TrustQuestion:
        content = its.content
        before = None if wanted.recorded_text or its.agreed else self._store.trusted_before(content)
        return TrustQuestion(
            _printable(wanted.info.task),
            wanted.recorded_text,
            asked_files(content, before),
            tuple(map(_printable, content.unseen)),
            content.computed,
            before is not None,
            tuple(_printable(name) for name in before or () if name not in content.file_sums),
            wanted.followed,
            its.agreed,
        )


def asked_files(content: TaskContent, before: Mapping[str, str] | None = None) -> tuple[AskedFile, ...]:
    """What would run, file by file: the task's own first, then the modules, those that changed before the others.

    Args:
        before: `TaskContent.file_sums` of what was trusted before, if anything was; empty where that is not known.
    """
    paths = {content.name(path): path for path in content.texts}
    files: list[AskedFile] = []
    for name, found in content.file_sums.items():
        since = Since.SAME
        if before and before.get(name) != found:
            since = Since.CHANGED if name in before else Since.NEW
        shown = content.main if paths[name] == content.main else name
        files.append(AskedFile(_printable(shown), found[:SHORT_HASH], content.texts[paths[name]], since))
    # What is new to a person is not to be looked for in a long list.
    return (*files[:1], *sorted(files[1:], key=lambda file: file.since is Since.SAME))


def _registered(reference: RecordedTask) -> TaskName | NotCleared:
    """What is opened by its id, if an installed package has registered it."""
    if not looks_like_file(reference.env_id):
        return reference
    return NotCleared(
        f"a recording names the file {_printable(reference.env_id)} as its task, and a path that a recording names in place of "
        "an id is never opened: if you know the task's file, name it yourself with --task FILE"
    )


def _is_as_it_was(content: TaskContent) -> bool:
    """Whether opening the file would still run what was read."""
    try:
        return read_content(Path(content.main)).hash == content.hash
    except CannotRead:
        return False


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
    main, texts = below_one_folder(info.source_file, info.source)
    return TaskContent(main, {main: texts[main], **texts})


def _approved(wanted: CodeToRun, content: TaskContent) -> TaskName:
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


def in_words(question: TrustQuestion) -> str:
    """The code that a question is about, with its hash."""
    if question.recorded_text:
        return f"the text of {question.file} in recordings of {question.task} ({question.hash})"
    return f"{question.file} ({question.hash})"
