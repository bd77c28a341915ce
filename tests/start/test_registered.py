"""ManiSkill's tasks are listed once and drawn once, in a process that is replaced here."""

from __future__ import annotations

import asyncio
import io
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from PIL import Image

from tests.drive.waiting import TIMEOUT_SECONDS, until
from workbench.live.questions_without_task import DrawTask, ListTasks, TaskPicture
from workbench.machine.loop import do
from workbench.start import registered as module
from workbench.start.registered import HEIGHT_PIXELS, LIST_FILE, WIDTH_PIXELS, RegisteredTasks, RegisteredView


class Process:
    """Answers questions; `lists` and `draws` are values, exceptions to raise, or None for no answer at all."""

    def __init__(self) -> None:
        self.lists: Any = ["B-v1", "A-v1"]
        self.draws: dict[str, Any] = {}
        self.asked: list[str] = []
        self.ends_after: list[int] = []
        """Number of questions before each end."""
        self.closed = 0

    def end(self) -> None:
        self.ends_after.append(len(self.asked))

    def close(self) -> None:
        self.closed += 1

    async def ask(self, question: Any) -> Any:
        self.asked.append(question.env_id if isinstance(question, DrawTask) else "list")
        answer = (
            self.lists if isinstance(question, ListTasks) else self.draws.get(question.env_id, quarters())
        )
        if isinstance(answer, Exception):
            raise answer
        if answer is None:
            await asyncio.Event().wait()
        return answer if isinstance(answer, list | TaskPicture) else TaskPicture(answer)


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Process:
    process = Process()

    def made(niceness: int) -> Process:
        assert niceness == 19, "drawing slows nothing else down"
        return process

    monkeypatch.setattr(module, "Background", made)
    return process


@pytest.fixture
def run(process: Process, tmp_path: Path) -> Iterator[Callable[..., RegisteredTasks]]:
    """Runs the work to its end; returns the tasks."""
    begun: list[RegisteredTasks] = []

    def run(
        may_work: Callable[[], bool] = lambda: True, ends: bool = True, folder: Path = tmp_path
    ) -> RegisteredTasks:
        tasks = RegisteredTasks(may_work, folder)
        begun.append(tasks)
        process.ends_after.clear()
        tasks.start()
        if ends:
            until(lambda: process.ends_after and not tasks.view.doing, "the end", seen=lambda: tasks.view)
        return tasks

    yield run
    for tasks in begun:
        tasks.close()


def quarters(height: int = 240, width: int = 320) -> np.ndarray:
    """A picture whose quarters are red, green, blue and white."""
    pixels = np.zeros((height, width, 3), np.uint8)
    top, left = height // 2, width // 2
    pixels[:top, :left], pixels[:top, left:] = (255, 0, 0), (0, 255, 0)
    pixels[top:, :left], pixels[top:, left:] = (0, 0, 255), (255, 255, 255)
    return pixels


def test_tasks_are_asked_for_and_drawn_once_and_known_to_the_next_run(
    process: Process, run: Callable[..., RegisteredTasks], tmp_path: Path
) -> None:
    process.lists = ["B-v1", "../evil", "A-v1"]
    view = run().view
    assert process.asked == ["list", "A-v1", "B-v1"] and view.ids == ("A-v1", "B-v1")
    assert view.pictures == {"A-v1", "B-v1"} and not view.problem and view.waiting == 0
    assert msgspec.json.decode((tmp_path / LIST_FILE).read_bytes())["ids"] == ["A-v1", "B-v1"]
    again = run(ends=False)
    until(lambda: again.view.pictures, "the cached ones")
    assert again.view.ids == view.ids and len(process.asked) == 3
    (tmp_path / "A-v1.jpg").unlink()
    assert run().view.pictures == {"A-v1", "B-v1"} and process.asked[3:] == ["A-v1"]
    (tmp_path / LIST_FILE).write_text("{")
    run()
    assert process.asked[4:] == ["list"]


@pytest.mark.parametrize(("height", "width"), [(240, 320), (100, 400), (640, 160), (30, 40)])
def test_a_picture_covers_the_size_of_a_row_around_its_centre(
    process: Process, run: Callable[..., RegisteredTasks], height: int, width: int
) -> None:
    process.draws["A-v1"] = quarters(height, width)
    picture = np.asarray(Image.open(io.BytesIO(run().picture("A-v1") or b""))).astype(int)
    assert picture.shape == (HEIGHT_PIXELS, WIDTH_PIXELS, 3)
    for y, x, colour in (
        (20, 20, (255, 0, 0)),
        (20, -20, (0, 255, 0)),
        (-20, 20, (0, 0, 255)),
        (-20, -20, (255,) * 3),
    ):
        assert np.abs(picture[y, x] - colour).max() < 40
    middle = (
        picture[HEIGHT_PIXELS // 2 - 12, WIDTH_PIXELS // 2 - 12],
        picture[HEIGHT_PIXELS // 2 + 12, WIDTH_PIXELS // 2 + 12],
    )
    assert np.abs(middle[0] - (255, 0, 0)).max() < 60 and np.abs(middle[1] - 255).max() < 60


def test_failed_tasks_are_counted_come_last_and_do_not_stop_the_others(
    process: Process, run: Callable[..., RegisteredTasks], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    process.lists = ["A-v1", "B-v1", "C-v1", "D-v1", "E-v1"]
    process.draws = {
        "A-v1": TaskPicture(None, "it needs assets", True),
        "B-v1": module.JobFailed("it crashed"),
        "C-v1": np.zeros((4, 4), np.uint8),
        "D-v1": np.zeros((0, 4, 3), np.uint8),
    }
    before = time.time()
    view = run().view
    why = view.why_not
    assert view.pictures == {"E-v1"} and set(why) == {"A-v1", "B-v1", "C-v1", "D-v1"} and view.waiting == 0
    assert [why[one].needs_download for one in sorted(why)] == [True, False, False, False]
    assert (why["A-v1"].text, why["B-v1"].text) == ("it needs assets", "it crashed")
    assert all(one.tries == 1 and before <= one.last <= time.time() for one in why.values())
    (tmp_path / "E-v1.jpg").unlink()
    process.asked.clear()
    del process.draws["B-v1"]
    view = run().view
    assert process.asked == ["E-v1", "A-v1", "B-v1", "C-v1", "D-v1"], "what failed comes last"
    assert view.pictures == {"B-v1", "E-v1"} and view.why_not["A-v1"].tries == 2
    process.asked.clear()
    run()
    assert process.asked == []
    # After a week it is tried again.
    now = time.time()
    monkeypatch.setattr(
        module, "time", type("Later", (), {"time": staticmethod(lambda: now + 8 * 24 * 3600)})
    )
    view = run().view
    assert process.asked == ["A-v1", "C-v1", "D-v1"] and view.why_not["A-v1"].tries == 3


def test_drawing_waits_while_it_may_not_work(process: Process, run: Callable[..., RegisteredTasks]) -> None:
    allowed = threading.Event()
    tasks = run(allowed.is_set, ends=False)
    until(lambda: process.ends_after, "the end of the process, to free its memory")
    assert process.asked == ["list"] and tasks.view.waiting == 2 and not tasks.view.pictures
    allowed.set()
    until(lambda: len(tasks.view.pictures) == 2, "the pictures", TIMEOUT_SECONDS)


def test_the_process_is_renewed_after_some_pictures(
    process: Process, run: Callable[..., RegisteredTasks], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PICTURES_PER_PROCESS", 2)
    process.lists = [f"T{number}-v1" for number in range(5)]
    run()
    assert process.ends_after == [3, 5, 6]


@pytest.mark.parametrize("what", ["list", "folder", "ManiSkill"])
def test_a_list_that_cannot_be_made_says_why(
    process: Process,
    run: Callable[..., RegisteredTasks],
    what: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if what == "list":
        process.lists = module.JobFailed("it crashed [1]")
    elif what == "folder":
        (tmp_path / "file").touch()
    else:
        monkeypatch.setattr(module, "lines_if_lacking", lambda what: ("It needs ManiSkill [3].", "Type: pip"))
    view = run(folder=tmp_path / "file" / "tasks" if what == "folder" else tmp_path).view
    said = {
        "list": "it crashed [1]",
        "folder": "Not a directory",
        "ManiSkill": "It needs ManiSkill [3]. Type: pip",
    }
    assert said[what] in view.problem and not view.pictures and not view.doing
    assert process.asked == {"list": ["list"], "folder": ["list", "A-v1"], "ManiSkill": []}[what]
    assert bool(view.ids) == (what == "folder")


def test_lists_of_other_versions_are_kept_apart(
    process: Process, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folders = set()
    for versions in ({"mani_skill": "3.0.1"}, {"mani_skill": "3.0.2"}, {"mani_skill": "3/" + "0" * 200}, {}):
        monkeypatch.setattr(module, "installed_maniskills", lambda versions=versions: versions)
        tasks = RegisteredTasks()
        tasks.start()
        until(lambda tasks=tasks: len(tasks.view.pictures) == 2 and not tasks.view.doing, "the pictures")
        tasks.close()
        (new,) = {file.parent for file in tmp_path.rglob(LIST_FILE)} - folders
        assert new.parent == tmp_path / "workbench" / "tasks"
        folders.add(new)
    assert {"mani_skill-3.0.1", "mani_skill-3.0.2"} < {folder.name for folder in folders}


def test_a_task_that_cannot_be_drawn_is_not_retried_forever(
    process: Process, run: Callable[..., RegisteredTasks]
) -> None:
    process.lists, process.draws = ["A-v1"], {"A-v1": module.JobFailed("it crashed")}
    for _ in range(module.MAX_TRIES):
        run()
    again = run(ends=False)
    until(lambda: again.view.why_not and not again.view.doing, "its end")
    assert process.asked == ["list", *["A-v1"] * module.MAX_TRIES]


def test_a_thumbnail_that_times_out_is_omitted_and_its_process_ended(
    process: Process, run: Callable[..., RegisteredTasks], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "ANSWER_SECONDS", 0.01)
    process.draws = {"A-v1": None, "B-v1": None}
    tasks = run()
    assert process.ends_after[:2] == [2, 3] and "longer than" in tasks.view.why_not["A-v1"].text
    assert set(tasks.view.why_not) == {"A-v1", "B-v1"}


def test_close_stops_a_running_thumbnail_and_starts_no_other(
    process: Process, run: Callable[..., RegisteredTasks], tmp_path: Path
) -> None:
    process.draws = {"A-v1": None}
    tasks = run(ends=False)
    until(lambda: process.asked == ["list", "A-v1"], "the question")
    tasks.close()
    until(lambda: not tasks.view.doing, "its end")
    assert process.closed == 1 and not tasks.view.why_not
    never = RegisteredTasks(folder=tmp_path)
    never.close()
    never.start()
    do(lambda: None)
    assert never.view == RegisteredView() and process.asked == ["list", "A-v1"]


@pytest.mark.slow
def test_maniskills_tasks_are_listed_and_drawn_once(child_process: None, tmp_path: Path) -> None:
    first = RegisteredTasks(folder=tmp_path)
    first.start()
    first.start()
    # The first tasks lack a download on most machines; this is not shown as broken.
    until(lambda: first.view.pictures or first.view.problem, "a picture", 280, lambda: first.view)
    view = first.view
    first.close()
    assert "PickCube-v1" in view.ids and not view.problem
    drawn = next(iter(view.pictures))
    picture = Image.open(io.BytesIO(first.picture(drawn) or b""))
    assert picture.size == (WIDTH_PIXELS, HEIGHT_PIXELS)
    assert np.asarray(picture).std() > 5, "the picture is not empty"
    again = RegisteredTasks(lambda: False, folder=tmp_path)
    again.start()
    until(lambda: again.view.pictures, "the cached one")
    again.close()
    assert again.view.ids == view.ids and again.view.why_not.keys() >= view.why_not.keys()
