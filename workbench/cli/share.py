"""Runs ``workbench share``, ``export`` and ``view`` in a terminal."""

from __future__ import annotations

# The modules that make files and pages are imported in the functions: `workbench view` must not wait for them.
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import TimeRemainingColumn

from workbench.cli.output import Exit, interrupted, print_addresses, print_text, progress_bar, refuse, warn

if TYPE_CHECKING:
    from workbench.episodes.lerobot.export import ExportOptions
    from workbench.episodes.row import Source
    from workbench.share.make import Made, MakeRequest

SCENE, CAMERAS = "scene", "cameras"


def share_in_terminal(
    files: Sequence[Path],
    mp4: Sequence[str],
    html: bool,
    sheet: bool,
    out: Path,
) -> int:
    """Make films, pages and sheets from recordings; returns the exit code."""
    from workbench.share.make import EVERY_CAMERA, MakeRequest

    def requests(sources: tuple[Source, ...]) -> list[MakeRequest]:
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
    return _make_all(files, requests)


def export_in_terminal(files: Sequence[Path], folder: Path, options: ExportOptions) -> int:
    """Export recordings to a LeRobot dataset; returns the exit code."""
    from workbench.share.make import MakeRequest

    return _make_all(files, lambda sources: [MakeRequest("lerobot", sources, folder, export=options)])


def demonstrations_in_terminal(
    files: Sequence[Path], file: Path, only_successes: bool, only_fitting: bool
) -> int:
    """Export recordings to one file of ManiSkill demonstrations; returns the exit code."""
    from workbench.episodes.lerobot.export import ExportOptions
    from workbench.share.make import MakeRequest

    options = ExportOptions(only_successes=only_successes, only_fitting=only_fitting)
    return _make_all(files, lambda sources: [MakeRequest("maniskill", sources, file, export=options)])


def _make_all(files: Sequence[Path], requests_of: Callable[[tuple[Source, ...]], list[MakeRequest]]) -> int:
    from workbench.episodes.lerobot.export import DoesNotFit
    from workbench.episodes.maniskill.export import OtherDemonstration
    from workbench.episodes.reader.reading import find_all_sources
    from workbench.episodes.row import UnreadableRecording
    from workbench.share.make import make

    try:
        requests = requests_of(find_all_sources(files))
    except (OSError, ValueError) as error:
        return refuse(str(error))
    made: list[tuple[MakeRequest, Made]] = []
    refused: list[str] = []
    damaged = False
    try:
        with progress_bar(TimeRemainingColumn()) as bar:
            row = bar.add_task("reading", total=len(requests))
            for number, request in enumerate(requests):

                def on_progress(done: float, doing: str, number: int = number) -> None:
                    bar.update(row, completed=number + done, description=doing)

                try:
                    made.append((request, make(request, on_progress)))
                except (DoesNotFit, OtherDemonstration, UnreadableRecording) as error:
                    damaged = damaged or isinstance(error, UnreadableRecording)
                    advice = (
                        " With --only-fitting such recordings are left out." if request.is_dataset else ""
                    )
                    refused.append(f"{error}{advice}")
                except ValueError as error:
                    refused.append(str(error))
    except (OSError, RuntimeError) as error:
        return refuse(str(error))
    except KeyboardInterrupt:
        return interrupted("finished files are kept")
    finally:
        for request, one in made:
            for path in one.paths:
                print_text(f"{path}: {one.words}" if request.is_dataset else path)
    for why in refused:
        for line in why.split("\n"):
            refuse(line)
    fewer = damaged or (bool(made) and bool(refused))
    for request, one in made:
        for why in (*one.damaged, *one.left_out, *one.incomplete):
            warn(why)
        # A dataset leaves recordings out only on request (--only-fitting).
        fewer = fewer or bool(one.damaged) or (bool(one.left_out) and not request.is_dataset)
    return Exit.FAILED if fewer else Exit.REFUSED if refused else Exit.DONE


def view_in_terminal(files: Sequence[Path], web: bool, host: str, port: int) -> int:
    """Show recordings in rerun's viewer until the window is closed or Ctrl-C; returns the exit code.

    The viewer is shown in a page instead of a window if `web` is True or there is no display.
    """
    from workbench.episodes.rerun.viewer import has_screen, open_window, resolve_recordings

    try:
        if web or not has_screen(os.environ):
            return _in_page(resolve_recordings(files), host, port)
        viewer = open_window(files)
    except (OSError, ValueError, RuntimeError) as error:
        return refuse(str(error))
    try:
        viewer.wait()
    except RuntimeError as error:
        return refuse(str(error))
    except KeyboardInterrupt:
        print_text("closing")
    finally:
        viewer.close()
    return 0


def _in_page(files: Sequence[Path], host: str, port: int) -> int:
    from workbench.episodes.rerun.viewer import web_viewer_folder
    from workbench.page.door.file_response import Downloads
    from workbench.page.door.gated_server import ServerOptions, open_server
    from workbench.share.rerun_panel import RerunPages

    web_viewer_folder()
    gated_server = open_server(ServerOptions(host=host, port=port))
    try:
        address = RerunPages(gated_server, Downloads(gated_server.add_route)).address(files)
        if gated_server.warning:
            warn(gated_server.warning)
        print_addresses(gated_server.addresses(address))
        print_text(f"  remote  {gated_server.ssh_hint}")
        print_text("  Ctrl-C ends it.")
        while True:
            # Short sleeps, because a signal that the kernel delivers to another thread does not wake this one.
            time.sleep(0.2)
    except KeyboardInterrupt:
        print_text("closing")
    finally:
        gated_server.close()
    return 0
