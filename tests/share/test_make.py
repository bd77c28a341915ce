"""What is made of recordings: names, progress, and results of the running job, without a process."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from tests.drive.episodes import made, write
from tests.drive.waiting import TIMEOUT_SECONDS, until
from workbench.episodes.row import Source
from workbench.jobs.scheduler import PoolError
from workbench.share import make as module
from workbench.share.make import (
    MAX_SENTENCES,
    Made,
    MakeRequest,
    Making,
    MakingView,
    file_name,
    make,
    seconds_a_step,
    zip_name,
)
from workbench.share.panel import Chosen, dataset_name, short_names, will_make


def test_files_are_named_after_their_recording_and_camera() -> None:
    names = [file_name(what, "a.b", "hand/camera") for what in ("film", "scene", "page", "sheet")]
    assert names == ["a.b.hand_camera.mp4", "a.b.scene.mp4", "a.b.html", "a.b.sheet.png"]
    assert [zip_name(["a"]), zip_name(["a", "b"]), zip_name("abcd")] == [
        "a.zip", "a_and_1_more.zip", "a_and_3_more.zip",
    ]  # fmt: skip
    assert dataset_name("lerobot", "now") == "lerobot_now"
    assert dataset_name("maniskill", "now") == "demonstrations_now.h5"
    day = "Push_seed1_2026-11-22T01-07-22"
    assert short_names([day, f"{day}_2"]) == ["Push_seed1", "Push_seed1_2"]
    assert short_names([day, "Push_seed1_2026-11-23T01-07-22"]) == [day, "Push_seed1_2026-11-23T01-07-22"]
    assert seconds_a_step(made(2, control_dt=0.1)) == 0.1 and seconds_a_step(made(2, control_dt=0.0)) == 0.05


def test_the_sentences_about_recordings_are_counted() -> None:
    few = Made((), "", ("left",), ("damaged",), ("incomplete",))
    assert few.said == ("damaged", "left", "incomplete")
    said = Made((), "", tuple(map(str, range(MAX_SENTENCES + 2)))).said
    assert said[:-1] == tuple(map(str, range(MAX_SENTENCES))) and "2" in said[-1]
    assert len(Made((), "", tuple("x" * MAX_SENTENCES)).said) == MAX_SENTENCES


ONE, MANY = (Source(Path("/r/a.json")),), tuple(Source(Path(f"/r/{name}.json")) for name in "abc")
CAMERAS = ("eye", "hand")


@pytest.mark.parametrize(
    ("what", "sources", "camera", "files"),
    [
        ("film", ONE, "", ["a.eye.mp4", "a.hand.mp4"]),
        ("film", ONE, "hand", ["a.hand.mp4"]),
        ("film", MANY, "hand", ["a.hand.mp4", "b.hand.mp4", "c.hand.mp4"]),
        ("film", MANY, "", []),
        ("film", ONE, "gone", ["a.eye.mp4", "a.hand.mp4"]),
        ("scene", MANY, "hand", ["a.scene.mp4", "b.scene.mp4", "c.scene.mp4"]),
        ("page", ONE, "", ["a.html"]),
        ("sheet", ONE, "", ["a.sheet.png"]),
        ("zip", MANY, "", ["a_and_2_more.zip"]),
    ],
)
def test_the_files_are_named_before_they_are_made(
    what: Any, sources: Any, camera: str, files: list[str]
) -> None:
    will = will_make(what, Chosen(sources, CAMERAS), camera, Path("/r"))
    assert [name for name, _ in will["files"]] == files and will["where"] == will["note"] == ""
    if len(files) > 1 or what in ("page", "sheet"):
        assert will["what"] == f"{len(files)} file{'s' * (len(files) > 1)}"


@pytest.mark.parametrize(
    ("successes", "only", "counted", "noted"),
    [
        (None, True, "3", False),
        (2, True, "2 of these 3", False),
        (2, False, "3", False),
        (0, True, "3", True),
    ],
)
def test_a_dataset_says_how_many_recordings_it_takes(
    successes: int | None, only: bool, counted: str, noted: bool
) -> None:
    for what, name in (("lerobot", "lerobot_"), ("maniskill", "demonstrations_")):
        will = will_make(what, Chosen(MANY, successes=successes), "", Path("/r"), only)  # type: ignore[arg-type]
        assert counted in will["what"] and bool(will["note"]) == noted
        assert ("2 of these" in will["what"]) == (counted != "3")
        assert will["where"].startswith(f"/r/datasets/{name}") and will["files"] == ()
    assert will_make("lerobot", Chosen(ONE, successes=0), "", Path("/r"))["note"] != will["note"]


def test_progress_covers_all_recordings_in_order(tmp_path: Path, child_process: None) -> None:
    sources = []
    for seed in (1, 2):
        path = write(tmp_path / str(seed), made(2, seed=seed))
        sources.append(Source(path))
    (tmp_path / "gone").mkdir()
    sources.append(Source(tmp_path / "gone" / "gone.json"))
    seen: list[tuple[float, str]] = []
    done = make(
        MakeRequest("sheet", tuple(sources), tmp_path / "out"),
        lambda share, doing: seen.append((share, doing)),
    )
    shares = [share for share, _ in seen]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] == 1
    for number, source in enumerate(sources[:2]):
        assert (number / 3, source.stem) in seen
    assert [path.name for path in done.paths] == [f"{source.stem}.sheet.png" for source in sources[:2]]
    assert all(Image.open(path).size[0] > 10 for path in done.paths)
    assert len(done.left_out) == 1 and "gone" in done.left_out[0] and done.words.startswith("2 files; 1 ")
    with pytest.raises(ValueError, match=sources[0].stem):
        make(MakeRequest("film", (sources[0],), tmp_path / "out", camera="none"))


# --- the running job -------------------------------------------------------------------------------------


class Work:
    """Replaces the process of the job."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wanted: list[MakeRequest] = []
        self.result: Callable[[MakeRequest], Made | str | Exception] = lambda wanted: Made((), "made")
        self.go_on, self.stopped = threading.Event(), False
        self.go_on.set()
        monkeypatch.setattr(module, "Processes", lambda count: SimpleNamespace(run=self.run))

    def run(self, work: Any, scheduler: Any) -> None:
        self.wanted.append(work.setup)
        scheduler.next("it")
        scheduler.update((0.5, "half"))
        self.go_on.wait(TIMEOUT_SECONDS)
        self.stopped = scheduler.limit() == 0
        result = self.result(work.setup)
        if isinstance(result, Exception):
            raise result
        if not self.stopped:
            scheduler.result("it", 0, result)


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Work:
    return Work(monkeypatch)


@pytest.fixture
def making() -> Iterator[Making]:
    making = Making()
    yield making
    making.close()


def ended(making: Making) -> MakingView:
    until(lambda: not making.view().running, "the end")
    return making.view()


def test_one_job_at_a_time_with_its_progress_and_the_newest_result_first(making: Making, work: Work) -> None:
    assert making.view() == MakingView()
    for words in ("first", "second"):
        work.go_on.clear()
        work.result = lambda wanted, words=words: Made((), words)
        assert making.start(MakeRequest("zip", (), Path("/out")))
        assert not making.start(MakeRequest("film", (), Path("/out")))
        until(lambda: making.view().doing == "half", "the progress")
        assert making.view().running and making.view().done == 0.5
        work.go_on.set()
        ended(making)
    assert [one.words for one in making.view().made] == ["second", "first"] and not making.view().problem
    assert [one.what for one in work.wanted] == ["zip", "zip"] and work.wanted[0].folder == Path("/out")


@pytest.mark.parametrize(
    ("result", "said"),
    [
        ("there is no picture", "there is no picture"),
        (PoolError("a process was killed"), "a process was killed"),
        (OSError("no more processes"), "no more processes"),
    ],
)
def test_a_failed_job_says_why_and_keeps_the_other_results(
    making: Making, work: Work, result: Any, said: str
) -> None:
    making.start(MakeRequest("zip", (), Path("/out")))
    ended(making)
    work.result = lambda wanted: result
    making.start(MakeRequest("zip", (), Path("/out")))
    view = ended(making)
    assert said.lower() in view.problem.lower() and [one.words for one in view.made] == ["made"]
    work.result = lambda wanted: Made((), "again")
    making.start(MakeRequest("zip", (), Path("/out")))
    assert ended(making).problem == ""


def test_a_stopped_job_reports_nothing_and_the_next_one_runs(making: Making, work: Work) -> None:
    work.go_on.clear()
    work.result = lambda wanted: PoolError("was stopped") if work.stopped else Made((), "made")
    making.start(MakeRequest("zip", (), Path("/out")))
    until(lambda: work.wanted, "the work")
    making.stop()
    work.go_on.set()
    view = ended(making)
    assert work.stopped and (view.problem, view.made) == ("", ())
    making.start(MakeRequest("zip", (), Path("/out")))
    assert [one.words for one in ended(making).made] == ["made"]


def test_closing_waits_for_work_in_progress_but_not_forever(
    making: Making, work: Work, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "END_SECONDS", 0.1)
    work.go_on.clear()
    making.start(MakeRequest("zip", (), Path("/out")))
    making.close()
    assert making.view().running, "the hanging work still runs"
    work.go_on.set()
    view = ended(making)
    assert (view.problem, view.made) == ("", ())


def test_each_download_has_a_folder_of_its_own_until_the_end(making: Making, work: Work) -> None:
    def write_two(wanted: MakeRequest) -> Made:
        paths = tuple(wanted.folder / name for name in ("a", "b"))
        for size, path in enumerate(paths, 3):
            path.write_bytes(b"x" * size)
        return Made(paths, "made")

    work.result = write_two
    for download in (True, True, False):
        folder = Path("/out") if download else work.wanted[0].folder
        making.start(replace(MakeRequest("zip", (), folder)), download=download)
        ended(making)
    kept, second, first = making.view().made
    assert first.sizes == second.sizes == (3, 4) and kept.sizes == (), "a file that stays is no download"
    assert first.paths[0].parent != second.paths[0].parent and first.paths[0].exists()
    making.close()
    assert not any(path.exists() for path in (*first.paths, *second.paths))
