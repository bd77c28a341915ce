"""The Rescore tab of the review: reruns recorded episodes with the current or other code, and lists the differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import viser

from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.recorded_source import class_in, recorded_version, reference_of
from workbench.episodes.row import Source
from workbench.library.folder import Library
from workbench.live.timeline_commands import Seek, StopRescoring
from workbench.page.command import Command, Refused
from workbench.page.widgets.fields import by_name, choice, tick
from workbench.page.widgets.line_chart import part_round
from workbench.page.widgets.notices import notify_all
from workbench.page.widgets.templates import counted, render
from workbench.page.widgets.tools import tool, tools_html
from workbench.page.widgets.visitors import Visitor
from workbench.rescore import verdict_text
from workbench.rescore.recording_jobs import Rescorer
from workbench.rescore.result_parts import RescoredPanel
from workbench.rescore.state import RUNNING
from workbench.rescore.verdict import Verdict, by_change
from workbench.review.commands import ChooseRescoreCode, RescoreOpen, RestoreRecordedStates, SelectRecording
from workbench.review.playback import Review
from workbench.review.view import ReviewView
from workbench.task.reference import RecordedTask, named_file

TODAYS, RECORDED = "today's", "as recorded"
MAX_NAMES = 3


@dataclass(frozen=True)
class Code:
    """A choice of the code that rescores recordings. A page sends only its label, never a path."""

    label: str = field(compare=False)
    source_text: str = field(compare=False)
    """Text for the page. It names the files."""
    file: Path | None = None
    """File to use for the tasks in it, instead of the files named by the recordings."""
    recorded: bool = False


def codes_for(infos: Sequence[EpisodeInfo], known: Sequence[Path]) -> tuple[Code, ...]:
    """The choices for these recordings; the current code and the recorded text are always the first two.

    Args:
        infos: Infos of the open recordings; other recordings are not read before they are rescored.
        known: Task files that the server knows; those that the recordings name are skipped.
    """
    named = list({str(reference): reference for reference in map(reference_of, infos)}.values())
    own = {file for file in map(named_file, named) if file is not None}
    codes = [Code(TODAYS, _todays(infos, named)), Code(RECORDED, _recorded(infos), recorded=True)]
    for file in dict.fromkeys(known):
        # Without open recordings the tasks are unknown: list every file. A recording whose task is not in the
        # chosen file is rescored with the file that it names.
        if file not in own and (not infos or any(class_in(file, info.task) for info in infos)):
            taken = {code.label for code in codes}
            label = file.name if file.name not in taken else str(Path(file.parent.name, file.name))
            if label not in taken:
                codes.append(Code(label, f"With {file} as it is now.", file))
    return tuple(codes)


def _todays(infos: Sequence[EpisodeInfo], named: Sequence[RecordedTask]) -> str:
    if not infos:
        return "Each recording with the file it names, as it is now."
    texts = [_in_words(reference) for reference in named[:MAX_NAMES]]
    more = f", and {len(named) - MAX_NAMES} more" if len(named) > MAX_NAMES else ""
    return f"With {', '.join(texts)}{more}."


def _in_words(reference: RecordedTask) -> str:
    file = named_file(reference)
    return f"{reference} as a package registers it" if file is None else f"{file} as it is now"


def _recorded(infos: Sequence[EpisodeInfo]) -> str:
    hashes = list(dict.fromkeys(version for info in infos if (version := recorded_version(info))))
    version = f" (version {', '.join(hashes[:MAX_NAMES])})" if hashes else ""
    return f"With the code stored in each recording{version}. It runs here; for recordings made elsewhere you are asked first."


IDLE = (
    "Runs the current reward and evaluate over recorded episodes, from their seeds and with their actions, and lists what is "
    "different now. Select recordings in the Library and click Rescore there, or rescore the open ones."
)


@dataclass
class RescoreChoices:
    """Options of rescoring, kept while pages are replaced."""

    code: Code = Code(TODAYS, "")
    use_env_states: bool = False


def episode_files(library: Library, ids: Sequence[str]) -> list[Source]:
    """The sources of these recordings, without those that are no longer in the library."""
    rows = {row.id: row for row in library.view().rows}
    return [row.source for row in (rows[id] for id in dict.fromkeys(ids) if id in rows) if row.paths]


class RescorePanel(RescoredPanel[ReviewView, Source]):
    """The parts of the Rescore tab, in the current container.

    Args:
        server: The page.
        rescorer: Rescores the recordings.
        review: The review that shows the episode of a row, and has the open recordings.
        library: Library of the recordings that may be rescored.
        choices: Choices that are kept while pages are replaced.
        known: Returns other task files that the server knows.
    """

    does = (*RescoredPanel.does, StopRescoring, RescoreOpen, ChooseRescoreCode, RestoreRecordedStates)
    advice = verdict_text.PUT_IN

    def __init__(
        self,
        server: viser.ViserServer,
        rescorer: Rescorer,
        review: Review,
        library: Library,
        choices: RescoreChoices,
        known: Callable[[], Sequence[Path]] = tuple,
    ) -> None:
        super().__init__(server, "episode")
        self._rescorer, self._review = rescorer, review
        self._library, self._choices, self._known = library, choices, known
        gui = server.gui
        self._begin = gui.add_html("")
        self._codes = codes_for((), known())
        self._codes_of: object = None
        self._code = choice(
            server,
            "Code",
            ChooseRescoreCode,
            "code",
            [code.label for code in self._codes],
            TODAYS,
            hint="The current code of the task, the recorded code, or a task file that is open here",
        )
        self._source_text = gui.add_html("")
        self._states = tick(
            server,
            "Recorded states",
            RestoreRecordedStates,
            "on",
            choices.use_env_states,
            hint="Restore the recorded state after every step, so that nothing drifts",
        )
        self._add_status("Stop")
        self._add_list()
        self._add_chart()
        self._selected: str | None = None

    def rescore_and_notify(self, ids: Sequence[str]) -> None:
        """Call `rescore` and notify every page; for a click outside this tab."""
        if not ids:
            notify_all(self._server, "Nothing to rescore", "No recording is selected or open.")
            return
        self.rescore(ids)
        title = f"Rescoring {counted(len(ids), 'recording')}"
        notify_all(self._server, title, "What differs now is listed under Rescore.", None, 4.0)

    def rescore(self, ids: Sequence[str]) -> None:
        """Start rescoring these recordings of the library."""
        files = episode_files(self._library, ids)
        self._selected = None
        self._pages = self._pages.at(0)
        code = self._chosen()
        self._rescorer.start(
            files,
            file=code.file,
            recorded_source=code.recorded,
            use_env_states=self._choices.use_env_states,
        )

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case RescoreOpen():
                self.rescore([one.id for one in self._review.view().opened])
            case ChooseRescoreCode(code=label):
                code = next((code for code in self._codes if code.label == label), None)
                if code is None:
                    raise Refused("This code can no longer be chosen: choose another one from the list.")
                self._choices.code = code
            case RestoreRecordedStates(on=on):
                self._choices.use_env_states = on
            case StopRescoring():
                self._rescorer.do(command)
            case _:
                super().do(command, visitor)

    def _chosen(self) -> Code:
        """The chosen code; if it is no longer listed, the first choice, so that no code is used that the page
        does not show."""
        return next((code for code in self._codes if code == self._choices.code), self._codes[0])

    # --- drawing -----------------------------------------------------------------------------------

    def key(self, view: ReviewView) -> object:
        at = self._rescorer.view.serial, view.opened_serial, view.selected
        chosen = self._choices.code, self._choices.use_env_states
        return *at, self._pages.first, self._selected, self._codes_are_of(view), chosen

    def _codes_are_of(self, view: ReviewView) -> object:
        """Key of everything that the choices of code depend on."""
        return tuple(one.id for one in view.opened), tuple(self._known())

    def draw(self, view: ReviewView) -> None:
        self._draw_codes(view)
        rescored = self._rescorer.view
        can_begin = bool(view.opened) and rescored.state not in RUNNING
        begin = tool("Rescore the open recordings", RescoreOpen(), tone="main")
        self._begin.content = tools_html([begin] if can_begin else [])
        self._states.show(self._choices.use_env_states)
        self._draw_status(rescored, idle=IDLE)
        self._draw_list(by_change(rescored.verdicts))
        self._draw_curve()

    def _draw_codes(self, view: ReviewView) -> None:
        if self._codes_of != (wanted := self._codes_are_of(view)):
            self._codes_of = wanted
            self._codes = codes_for([one.episode.info for one in view.opened], self._known())
        chosen = self._chosen()
        self._code.show(chosen.label, options=by_name([code.label for code in self._codes]))
        self._source_text.content = render("note", text=chosen.source_text)

    def _key_of(self, verdict: Verdict[Source]) -> str:
        return verdict.of.id

    def _of_row(self, verdict: Verdict[Source]) -> dict[str, Any]:
        at = verdict.first_difference
        opened = [one.id for one in self._review.view().opened]
        return {
            # Index of the recording's colour, if the recording is one of several open ones.
            "badge": opened.index(verdict.of.id) if len(opened) > 1 and verdict.of.id in opened else None,
            "name": f"seed {verdict.seed}" if verdict.seed >= 0 else _end_of(verdict.of.name),
            "hint": f"{verdict.of.name}. Click to open it"
            + (f" at step {at}, the first that differs" if at is not None else ""),
            "selected": verdict.of.id == self._selected,
        }

    def _show(self, verdict: Verdict[Source]) -> None:
        self._selected = verdict.of.id
        view = self._review.view()
        opened = next((k for k, one in enumerate(view.opened) if one.id == verdict.of.id), None)
        if opened is None:
            self._review.open((verdict.of.id,), verdict.first_difference)
            return
        self._review.do(SelectRecording(id=verdict.of.id))
        if verdict.first_difference is not None:
            self._review.do(Seek(step=verdict.first_difference - view.anchors[opened]))

    def _draw_curve(self) -> None:
        chosen = next((v for v in self._listed if v.of.id == self._selected), None)
        if chosen is None:
            self._chart.hide()
            return
        part = part_round(chosen.length, chosen.first_difference)
        steps = np.arange(1, chosen.length + 1)
        name = f"seed {chosen.seed}" if chosen.seed >= 0 else chosen.of.name
        old, new = chosen.old_reward[part], chosen.new_reward[part]
        self._draw_chart(f"reward of {name}, then and now", steps[part], old, new)


def _end_of(name: str) -> str:
    """End of the name: the part that distinguishes recordings of a task."""
    return name if len(name) <= 24 else f"…{name[-23:]}"
