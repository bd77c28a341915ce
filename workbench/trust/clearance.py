"""Decides whether a listed file, or code of a recording, may run; asks the user if necessary."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.recorded_source import NoRecordedSource, relative_sources
from workbench.episodes.seal import InstallationSeal, made_here
from workbench.machine.text import short_line
from workbench.task.content import CannotRead, TaskContent, read_content
from workbench.task.reference import RecordedTask, TaskName, looks_like_file
from workbench.trust.store import TrustStore

HASH_CHARACTERS = 12
MAX_NAME_CHARACTERS = 400
"""Maximum length of a shown name."""
FOLLOWED = (
    "While the task is open live, every save of this file and of the modules next to it runs without asking, "
    "even if another program or person saves it. Rescore runs the file as it is at the time of rescoring."
)
"""Warning in a question about a file whose later saves will run too."""


class Consent(Enum):
    NO = "no"
    NONE = "none"
    """No to this and all other questions of the same call."""
    ONCE = "once"
    """Yes, until the program ends."""
    ALWAYS = "always"


class Since(Enum):
    """Difference of a file from the version that was trusted last."""

    SAME = "same"
    CHANGED = "changed"
    NEW = "new"


@dataclass(frozen=True)
class CodeFile:
    """A source text that would run."""

    name: str
    """Path of the task's own file; for a module, its path relative to the task's folder."""
    hash: str
    """First digits of its SHA-256."""
    text: str
    """The text, not escaped."""
    since: Since = Since.SAME


@dataclass(frozen=True)
class TrustQuestion:
    """A question to the user. Texts from recordings are made printable, not escaped."""

    task: str
    """Task of the recording that references the code; empty for a listed file."""
    recorded_text: bool
    """Whether the texts are those in the recording, not files on disk."""
    files: tuple[CodeFile, ...]
    """Files that would run, the task's own file first."""
    unseen: tuple[str, ...] = ()
    """Code that may run but is not among `files`."""
    computed: bool = False
    """Whether the task computes its imports, so that all files of its folder count as modules."""
    trusted_before: bool = False
    """Whether another version of the same files was trusted; `CodeFile.since` compares with it, unless
    `nothing_known`."""
    gone: tuple[str, ...] = ()
    """Modules of the last trusted version that no longer exist."""
    followed: bool = False
    """Whether later saves of these files run too."""
    agreed: bool = False
    """Whether these texts may run already, so that the question is only about later saves."""
    more: int = 0
    """Number of questions after this one."""
    listed: bool = False
    """Whether the user chose the file from a list; no recording references it."""

    @property
    def file(self) -> str:
        """A path, or the name of a file in a recording."""
        return self.files[0].name

    @property
    def hash(self) -> str:
        """Hash of the task's own file."""
        return self.files[0].hash

    @property
    def modules(self) -> tuple[CodeFile, ...]:
        """All files except the task's own."""
        return self.files[1:]

    @property
    def nothing_known(self) -> bool:
        """Whether a trusted version exists, but the hashes of its files were dropped, so changes cannot be
        marked."""
        return self.trusted_before and not self.gone and all(one.since is Since.SAME for one in self.files)


class NotCleared(Exception):
    """Code must not run; the message is the reason.

    Attributes:
        question: The question that would allow the code if the answer were yes; None if there is none.
        trust_helps: True if ``--trust`` would allow the code, but no answer to a question would.
    """

    def __init__(self, why: str, question: TrustQuestion | None = None, trust_helps: bool = False) -> None:
        super().__init__(why)
        self.question, self.trust_helps = question, trust_helps


class NotTrusted(Exception):
    """Nothing was run: some code has no consent (`questions`) or would need ``--trust`` (`reasons`)."""

    def __init__(self, questions: Sequence[TrustQuestion], reasons: Sequence[str] = ()) -> None:
        super().__init__("; ".join((*map(question_text, questions), *reasons)))
        self.questions, self.reasons = tuple(questions), tuple(reasons)


Ask = Callable[[TrustQuestion, Callable[[], bool]], Consent]
"""Asks the user and waits for the answer. Returns no as soon as its second argument, "stopped", returns True."""


@dataclass(frozen=True)
class CodeToRun:
    """Code that a recording references or contains."""

    reference: TaskName
    """The task to open; not examined if `recorded_text` is True."""
    info: EpisodeInfo
    """Info of the recording."""
    recorded_text: bool = False
    """Whether to run the text in the recording."""
    followed: bool = False
    """Whether later saves of the file run too."""


@dataclass(frozen=True)
class _Undecided:
    """Texts that need a question to the user."""

    content: TaskContent
    agreed: bool
    """Whether the texts may run already, so that only later saves need a question."""


class Clearances:
    """Decides whether code of recordings and listed files may run. Asks the user about each text once.

    A recording is untrusted unless its seal proves that it was made here. Its task is opened without a
    question if it is an id of an installed package, a file that the user named (on the command line, or open
    live), or the file that this installation had open when it made the recording. For anything else the texts
    are read, not run, and the user is asked; the answer is stored by the hash of the texts. Exactly the
    approved texts run, even if the file changes later. Later saves run only if the user was asked about them
    too (`TrustQuestion.followed`) and said yes.

    Args:
        named: Returns the files that the user named: on the command line, or by having them open live.
        ask: Asks the user; None: every answer is no.
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
        """Whether the user can be asked."""
        return self._ask is not None

    def clear(self, code: CodeToRun, stopped: Callable[[], bool] = lambda: False) -> TaskName:
        """The task to open; asks the user if necessary, and waits for the answer.

        Raises:
            NotCleared: the code must not run.
        """
        (cleared,) = self.clear_all([code], stopped)
        if isinstance(cleared, NotCleared):
            raise cleared
        return cleared

    def clear_all(
        self, codes: Sequence[CodeToRun], stopped: Callable[[], bool] = lambda: False
    ) -> list[TaskName | NotCleared]:
        """The task to open, or the refusal, for each of `codes`; asks about each text once."""
        decisions = [self._without_asking(one) for one in codes]
        to_ask: dict[str, tuple[CodeToRun, _Undecided]] = {}
        for one, decision in zip(codes, decisions):
            if isinstance(decision, _Undecided):
                to_ask.setdefault(decision.content.hash, (one, decision))
        refused: dict[str, NotCleared] = {}
        none_of_them = False
        for place, (hash, (code, undecided)) in enumerate(to_ask.items()):
            question = replace(self._question(code, undecided), more=len(to_ask) - place - 1)
            answer = Consent.NO
            if not none_of_them:
                answer = self._answer(question, undecided.content, stopped)
            none_of_them = none_of_them or answer is Consent.NONE
            if answer in (Consent.NO, Consent.NONE):
                refused[hash] = NotCleared(f"{question_text(question)} was not allowed to run", question)
        cleared: list[TaskName | NotCleared] = []
        for one, decision in zip(codes, decisions):
            if not isinstance(decision, _Undecided):
                cleared.append(decision)
            elif decision.content.hash in refused:
                cleared.append(refused[decision.content.hash])
            elif not one.recorded_text and not _is_unchanged(decision.content):
                cleared.append(_changed(decision.content))
            else:
                cleared.append(_approved(one, decision.content))
        return cleared

    def clear_file(
        self, file: Path, class_name: str | None = None, stopped: Callable[[], bool] = lambda: False
    ) -> TaskName:
        """The task to open for a file that the user chose from a list. Later saves of the file run too.

        Asks the user if necessary, as `clear` does.

        Raises:
            NotCleared: the code must not run.
        """
        name = str(file) if class_name is None else f"{file}:{class_name}"
        if self._all_trusted or _is_named(str(file), self._named()):
            return name
        try:
            content = read_content(file)
        except CannotRead as error:
            raise NotCleared(str(error)) from error
        if not self._store.follows(content):
            agreed = self._store.trusts(content)
            before = None if agreed else self._store.trusted_before(content)
            question = _question(content, before, followed=True, agreed=agreed, listed=True)
            if self._answer(question, content, stopped) in (Consent.NO, Consent.NONE):
                raise NotCleared(f"{question_text(question)} was not allowed to run", question)
            if not _is_unchanged(content):
                raise _changed(content)
        # Exactly these texts, until the next save: the file may change before it is loaded.
        return RecordedTask(file.name, content.main, class_name, content.texts)

    def _answer(self, question: TrustQuestion, content: TaskContent, stopped: Callable[[], bool]) -> Consent:
        """Ask the question; a yes is stored."""
        answer = Consent.NO if self._ask is None or stopped() else self._ask(question, stopped)
        if answer is Consent.ALWAYS:
            self._store.trust(content, question.followed)
        elif answer is Consent.ONCE:
            self._store.trust_once(content, question.followed)
        return answer

    def refused_arguments(self, info: EpisodeInfo, made: InstallationSeal | None = None) -> str | None:
        """Why an env must not get the arguments of this recording; None if it may get them. A recording that
        was not made here must not name files for the env to read."""
        if self._all_trusted or (made or made_here(info)) is not InstallationSeal.NO:
            return None
        named = [_printable(text) for text in paths_in_arguments(info)]
        if not named:
            return None
        return (
            f"a recording of {_printable(info.task)}, not made here, names files that its env would read "
            f"({', '.join(named[:3])}): only --trust allows this"
        )

    def _without_asking(self, code: CodeToRun) -> TaskName | NotCleared | _Undecided:
        """The decision; `_Undecided` if it needs a question."""
        made = made_here(code.info)
        if (why := self.refused_arguments(code.info, made)) is not None:
            return NotCleared(why, trust_helps=True)
        if code.recorded_text:
            try:
                content = recorded_content(code.info)
            except NoRecordedSource as error:
                return NotCleared(str(error))
            trusted = made is not InstallationSeal.NO
        else:
            reference = code.reference
            if isinstance(reference, str):
                return reference
            if reference.file is None:
                return _registered(reference)
            if made is InstallationSeal.CONTENT_AND_PLACE and reference.file == code.info.source_file:
                return str(reference)
            if _is_named(reference.file, self._named()):
                return str(reference)
            try:
                content = read_content(Path(reference.file))
            except CannotRead as error:
                return NotCleared(str(error))
            trusted = made is not InstallationSeal.NO and _equals_recorded(content, code.info)
        agreed = trusted or self._all_trusted or self._store.trusts(content)
        if agreed and (not code.followed or self._all_trusted or self._store.follows(content)):
            return _approved(code, content)
        return _Undecided(content, agreed)

    def _question(self, code: CodeToRun, undecided: _Undecided) -> TrustQuestion:
        content = undecided.content
        before = None if code.recorded_text or undecided.agreed else self._store.trusted_before(content)
        question = _question(content, before, followed=code.followed, agreed=undecided.agreed)
        return replace(question, task=_printable(code.info.task), recorded_text=code.recorded_text)


def _question(
    content: TaskContent,
    before: Mapping[str, str] | None,
    *,
    followed: bool,
    agreed: bool,
    listed: bool = False,
) -> TrustQuestion:
    return TrustQuestion(
        task="",
        recorded_text=False,
        files=code_files(content, before),
        unseen=tuple(map(_printable, content.unseen)),
        computed=content.computed,
        trusted_before=before is not None,
        gone=tuple(_printable(name) for name in before or () if name not in content.file_sums),
        followed=followed,
        agreed=agreed,
        listed=listed,
    )


def _changed(content: TaskContent) -> NotCleared:
    return NotCleared(
        f"the code of {_printable(content.main)} was changed while you were asked about it; try again"
    )


def code_files(content: TaskContent, before: Mapping[str, str] | None = None) -> tuple[CodeFile, ...]:
    """The files that would run: the task's own first, then changed modules, then other modules.

    Args:
        before: `TaskContent.file_sums` of the last trusted version, if any; empty if its files are not known.
    """
    paths = {content.name(path): path for path in content.texts}
    files: list[CodeFile] = []
    for name, found in content.file_sums.items():
        since = Since.SAME
        if before and before.get(name) != found:
            since = Since.CHANGED if name in before else Since.NEW
        shown = content.main if paths[name] == content.main else name
        files.append(CodeFile(_printable(shown), found[:HASH_CHARACTERS], content.texts[paths[name]], since))
    # Changed modules first, or they would be hard to find in a long list.
    return (*files[:1], *sorted(files[1:], key=lambda file: file.since is Since.SAME))


def _registered(reference: RecordedTask) -> TaskName | NotCleared:
    """The reference; a refusal if its env id is a path."""
    if not looks_like_file(reference.env_id):
        return reference
    return NotCleared(
        f"a recording names the file {_printable(reference.env_id)} in place of a task's id, and such a file is "
        "never opened: if you know the task's file, name it yourself with --task FILE"
    )


def _is_unchanged(content: TaskContent) -> bool:
    """Whether the file and its modules still have these texts."""
    try:
        return read_content(Path(content.main)).hash == content.hash
    except CannotRead:
        return False


def paths_in_arguments(info: EpisodeInfo) -> list[str]:
    """The texts in an env's recorded arguments that look like a path; a task may open such a path."""
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
    return "/" in text or "\\" in text or text.startswith("~") or ("." in text and os.path.lexists(text))


def recorded_content(info: EpisodeInfo) -> TaskContent:
    """The source text in a recording.

    Raises:
        NoRecordedSource: the recording has none.
    """
    if not info.source or info.source_file is None:
        raise NoRecordedSource("this recording does not hold the text of its task")
    main, texts = relative_sources(info.source_file, info.source)
    return TaskContent(main, {main: texts[main], **texts})


def _approved(code: CodeToRun, content: TaskContent) -> TaskName:
    if code.recorded_text or isinstance(code.reference, str):
        return code.reference
    return replace(code.reference, file=content.main, approved=content.texts)


def _equals_recorded(content: TaskContent, info: EpisodeInfo) -> bool:
    """Whether a file has the recorded text; if so, the recording's seal covers the file, in any folder."""
    try:
        return content.hash == recorded_content(info).hash
    except NoRecordedSource:
        return False


def _printable(text: str) -> str:
    return short_line(text, MAX_NAME_CHARACTERS)


def _is_named(file: str, named: Iterable[Path]) -> bool:
    real = os.path.realpath(file)
    return any(os.path.realpath(one) == real for one in named)


def question_text(question: TrustQuestion) -> str:
    """Name and hash of the code in question."""
    if question.recorded_text:
        return f"the text of {question.file} in recordings of {question.task} ({question.hash})"
    return f"{question.file} ({question.hash})"
