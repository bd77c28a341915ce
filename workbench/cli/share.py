"""``workbench share`` and ``workbench export`` in a terminal: a bar while it is made, and what was made at the end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from rich.progress import TimeRemainingColumn

from workbench.cli.terminal import progress_bar, refuse, say
from workbench.recording.episode.row import Source
from workbench.recording.lerobot.export import DoesNotFit, ExportOptions
from workbench.recording.reader.reading import find_all_sources
from workbench.ui.share.make import EVERY_CAMERA, Made, MakeRequest, make

SCENE, CAMERAS = "scene", "cameras"


def share_in_terminal(
    files: Sequence[Path],
    mp4: Sequence[str],
    html: bool,
    sheet: bool,
    out: Path,
) -> int:
    """Returns the exit code."""

    def wanted(sources: tuple[Source, ...]) -> list[MakeRequest]:
        films = [
            MakeRequest("scene", sources, out)
            if name == SCENE
            else MakeRequest("film", sources, out, EVERY_CAMERA if name == CAMERAS else name)
            for name in mp4
        ]
        return [
            *films,
            *[MakeRequest("page", sources, out)] * html,
            *[MakeRequest("sheet", sources, out)] * sheet,
        ]

    if not (mp4 or html or sheet):
        return refuse("say what to make: --mp4 CAMERA, --mp4 scene, --html or --sheet")
    return _make_all(files, wanted)


def export_in_terminal(files: Sequence[Path], folder: Path, options: ExportOptions) -> int:
    """Returns the exit code."""
    return _make_all(files, lambda sources: [MakeRequest("lerobot", sources, folder, export=options)])


def _make_all(files: Sequence[Path], wanted_of: Callable[[tuple[Source, ...]], list[MakeRequest]]) -> int:
    try:
        wanted = wanted_of(find_all_sources(files))
    except (OSError, ValueError) as error:
        return refuse(str(error))
    made: list[Made] = []
    not_made: list[str] = []
    try:
        with progress_bar(TimeRemainingColumn()) as bar:
            row = bar.add_task("reading", total=len(wanted))
            for number, one in enumerate(wanted):

                def told(done: float, doing: str, number: int = number) -> None:
                    bar.update(row, completed=number + done, description=doing)

                try:
                    made.append(make(one, told))
                    not_made += made[-1].not_made
                except DoesNotFit as error:
                    not_made.append(f"{error} With --only-fitting such recordings are left out.")
                except ValueError as error:
                    not_made.append(str(error))
    except (OSError, RuntimeError) as error:
        return refuse(str(error))
    except KeyboardInterrupt:
        return refuse("interrupted; what was finished is kept")
    finally:
        for one in made:
            for path in one.paths:
                say(path if path.is_file() else f"{path}: {one.words}")
    for why in not_made:
        refuse(why)
    return 2 if not_made else 0
