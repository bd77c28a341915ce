"""What ``workbench share``, ``export`` and ``view`` ask for, print and return; the list of ``workbench help``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from workbench.app.help_pages import GROUPS, topics
from workbench.cli.help import show_help
from workbench.cli.output import Exit
from workbench.cli.share import (
    demonstrations_in_terminal,
    export_in_terminal,
    share_in_terminal,
    view_in_terminal,
)
from workbench.episodes.lerobot.export import DoesNotFit, ExportOptions
from workbench.episodes.row import Source, UnreadableRecording
from workbench.share.make import Made, MakeRequest

SOURCES = (Source(Path("/r/a.json")), Source(Path("/r/b.json")))
OUT = Path("out")
Answers = dict[str, Made | BaseException]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Callable[[Answers], list[MakeRequest]]:
    """Replaces the making of files: each kind gives its answer, or one file."""

    def asked(answers: Answers) -> list[MakeRequest]:
        requests: list[MakeRequest] = []

        def make(wanted: MakeRequest, on_progress: Any) -> Made:
            requests.append(wanted)
            on_progress(0.5, "half [of it]")
            answer = answers.get(wanted.what, Made((wanted.folder / f"{wanted.what}.out",), "1 file"))
            if isinstance(answer, BaseException):
                raise answer
            return answer

        monkeypatch.setattr("workbench.share.make.make", make)
        monkeypatch.setattr("workbench.episodes.reader.reading.find_all_sources", lambda files: SOURCES)
        return requests

    return asked


def test_each_wish_is_one_request_and_its_files_are_printed(
    asked: Callable[[Answers], list[MakeRequest]], capsys: pytest.CaptureFixture[str]
) -> None:
    requests = asked({})
    assert share_in_terminal((), ("eye", "scene", "cameras"), True, True, OUT) == Exit.DONE
    assert requests == [
        MakeRequest("film", SOURCES, OUT, "eye"),
        MakeRequest("scene", SOURCES, OUT),
        MakeRequest("film", SOURCES, OUT, ""),
        MakeRequest("page", SOURCES, OUT),
        MakeRequest("sheet", SOURCES, OUT),
    ]
    names = ("film", "scene", "film", "page", "sheet")
    assert capsys.readouterr().out.splitlines() == [f"out/{name}.out" for name in names]
    requests.clear()
    assert share_in_terminal((), (), True, False, OUT) == Exit.DONE
    assert [one.what for one in requests] == ["page"]
    assert share_in_terminal((), (), False, True, OUT) == Exit.DONE
    assert [one.what for one in requests] == ["page", "sheet"]
    assert share_in_terminal((), (), False, False, OUT) == Exit.REFUSED and len(requests) == 2
    options = ExportOptions(only_successes=True, fps=5)
    assert export_in_terminal((), OUT, options) == Exit.DONE
    assert requests[-1] == MakeRequest("lerobot", SOURCES, OUT, export=options)
    assert demonstrations_in_terminal((), OUT, True, False) == Exit.DONE
    assert requests[-1] == MakeRequest("maniskill", SOURCES, OUT, export=ExportOptions(only_successes=True))
    assert demonstrations_in_terminal((), OUT, False, True) == Exit.DONE
    assert requests[-1].export == ExportOptions(only_fitting=True)
    assert capsys.readouterr().out.splitlines()[-1].endswith("out/maniskill.out: 1 file")


ONE = Made((Path("a.out"),), "1 file")
LEFT, DAMAGED = replace(ONE, left_out=("b was left out",)), replace(ONE, damaged=("b is cut",))
INCOMPLETE = replace(ONE, incomplete=("b lacks some",))


@pytest.mark.parametrize(
    ("answers", "code", "printed", "said"),
    [
        ({"page": LEFT}, Exit.FAILED, 2, ["b was left out"]),
        ({"page": DAMAGED}, Exit.FAILED, 2, ["b is cut"]),
        ({"page": INCOMPLETE}, Exit.DONE, 2, ["b lacks some"]),
        ({"page": ValueError("no scene\nat all")}, Exit.FAILED, 1, ["no scene", "at all"]),
        ({"page": ValueError("no"), "sheet": ValueError("nor")}, Exit.REFUSED, 0, ["no", "nor"]),
        ({"page": UnreadableRecording("cut"), "sheet": ValueError("no")}, Exit.FAILED, 0, ["cut", "no"]),
        ({"page": UnreadableRecording("cut"), "sheet": DoesNotFit("odd")}, Exit.FAILED, 0, ["cut", "odd"]),
        ({"sheet": OSError("the disk is full")}, Exit.REFUSED, 1, ["the disk is full"]),
        ({"sheet": RuntimeError("no renderer")}, Exit.REFUSED, 1, ["no renderer"]),
        ({"sheet": KeyboardInterrupt()}, Exit.INTERRUPTED, 1, ["interrupted"]),
    ],
)
def test_what_was_not_made_is_said_and_decides_the_exit_code(
    asked: Callable[[Answers], list[MakeRequest]],
    answers: Answers,
    code: Exit,
    printed: int,
    said: list[str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked(answers)
    assert share_in_terminal((), (), True, True, OUT) == code
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == printed and all(one in err for one in said)


@pytest.mark.parametrize(
    ("answer", "code", "advice"),
    [
        (LEFT, Exit.DONE, False),
        (DoesNotFit("b has another camera"), Exit.REFUSED, True),
        (UnreadableRecording("b is cut"), Exit.FAILED, True),
        (ValueError("no success"), Exit.REFUSED, False),
    ],
)
def test_a_dataset_leaves_out_only_on_request(
    asked: Callable[[Answers], list[MakeRequest]],
    answer: Any,
    code: Exit,
    advice: bool,
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked({"lerobot": answer})
    assert export_in_terminal((), OUT, ExportOptions()) == code
    assert ("--only-fitting" in capsys.readouterr().err) == advice


@pytest.mark.parametrize("display", ["", ":0"])
@pytest.mark.parametrize("web", [False, True])
def test_recordings_are_viewed_in_a_window_if_there_is_one(
    display: str,
    web: bool,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "a.rrd"
    file.touch()
    done: list[str] = []

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    window = SimpleNamespace(wait=interrupt, close=lambda: done.append("closed"))
    server = SimpleNamespace(
        warning="anyone can open it",
        addresses=lambda path: [f"http://x{path}"],
        ssh_hint="ssh",
        close=window.close,
    )
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    viewer = "workbench.episodes.rerun.viewer"
    monkeypatch.setattr(
        f"{viewer}.open_window", lambda files: (done.append(f"window {len(files)}"), window)[1]
    )
    monkeypatch.setattr(f"{viewer}.web_viewer_folder", lambda: tmp_path)
    opened: list[Any] = []
    monkeypatch.setattr(
        "workbench.page.door.gated_server.open_server", lambda at: (opened.append(at), server)[1]
    )
    monkeypatch.setattr("workbench.page.door.file_response.Downloads", lambda route: None)
    pages = SimpleNamespace(address=lambda files: f"/{'+'.join(one.name for one in files)}")
    monkeypatch.setattr("workbench.share.rerun_panel.RerunPages", lambda *_: pages)
    monkeypatch.setattr("workbench.cli.share.time", SimpleNamespace(sleep=interrupt))
    server.add_route = None
    assert view_in_terminal((file,), web, "localhost", 9) == 0
    printed = capsys.readouterr()
    assert done[-1] == "closed" and printed.out.splitlines()[-1] == "closing"
    if display and not web:
        assert done[0] == "window 1" and not opened
    else:
        assert (opened[0].host, opened[0].port) == ("localhost", 9) and len(done) == 1
        assert "http://x/a.rrd" in printed.out and "anyone can open it" in printed.err


def test_a_recording_that_cannot_be_viewed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    closed: list[bool] = []

    def fail(*_: object) -> None:
        raise RuntimeError("rerun ended")

    window = SimpleNamespace(wait=fail, close=lambda: closed.append(True))
    monkeypatch.setenv("DISPLAY", ":0")
    assert view_in_terminal((tmp_path / "gone.rrd",), False, "localhost", 9) == Exit.REFUSED
    monkeypatch.setattr("workbench.episodes.rerun.viewer.open_window", lambda files: window)
    assert view_in_terminal((), False, "localhost", 9) == Exit.REFUSED and closed == [True]
    assert "rerun ended" in capsys.readouterr().err


def test_help_without_a_topic_lists_each_topic_once_below_its_group(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert show_help(" ") == Exit.DONE
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    listed = [line[0] for line in lines if line and line[0] in {topic.name for topic in topics()}]
    wanted = [topic.name for _, group in GROUPS for topic in topics() if topic.group == group]
    assert [name for name in listed if name in wanted] == wanted
