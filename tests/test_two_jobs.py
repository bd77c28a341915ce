"""Of two concurrent jobs one is killed: the other finishes, the death is reported, and the next of its kind works."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.drive.processes import workers_of
from tests.drive.waiting import until
from tests.golden.make import GOLDEN
from workbench.episodes.episode import Episode
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.reader.reading import find_all_sources
from workbench.rescore.recording_jobs import Rescorer
from workbench.share.make import MakeRequest, Making
from workbench.trust.clearance import Clearances

pytestmark = pytest.mark.usefixtures("child_process")
EXIT_TIMEOUT_SECONDS = 200.0
FLUSH_SECONDS = 1.0
"""README promises that at most the last second is lost."""
POLICY = """
import time
from pathlib import Path
import torch

steps = 0

def act(obs):
    global steps
    steps += 1
    if steps == 4:
        Path("NAME.waits").touch()
        while not Path("NAME.may").exists():
            time.sleep(0.02)
    return torch.tensor([0.8, 0.1]).repeat(len(obs), 1)
"""


# --- two processes of the page --------------------------------------------------------------------------


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A golden recording with a camera, and next to it the task that it names."""
    for name in ("tasks", "v1/cameras"):
        shutil.copytree(GOLDEN / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


class Rescoring:
    process = "the process in the background"

    def __init__(self, place: Path) -> None:
        self._files = find_all_sources((place / "v1",))
        self._rescorer = Rescorer(Clearances(all_trusted=True))

    def start(self) -> None:
        self._rescorer.start(self._files)

    def pids(self) -> list[int]:
        return [worker.pid for keeper in workers_of(psutil.Process()) for worker in keeper.children()]

    def ended(self) -> bool:
        return self._rescorer.view.state in ("done", "failed")

    def problem(self) -> str:
        return self._rescorer.view.why

    def assert_right(self) -> None:
        (verdict,) = self._rescorer.view.verdicts
        assert (verdict.why_not, verdict.differs, verdict.length) == ("", False, 8)

    def close(self) -> None:
        self._rescorer.close()


class Filming:
    process = "a process that makes it"

    def __init__(self, place: Path) -> None:
        self._wanted = MakeRequest("film", find_all_sources([place / "v1"]), place / "films", "eye")
        self._making = Making()

    def start(self) -> None:
        assert self._making.start(self._wanted)

    def pids(self) -> list[int]:
        return running("workbench.jobs.local_processes")

    def ended(self) -> bool:
        return not self._making.view().running

    def problem(self) -> str:
        return self._making.view().problem

    def assert_right(self) -> None:
        ((film,),) = (made.paths for made in self._making.view().made)
        assert film.suffix == ".mp4" and film.stat().st_size > 1000
        assert list(film.parent.iterdir()) == [film]

    def close(self) -> None:
        self._making.close()


def running(module: str) -> list[int]:
    """Pids of this process's kept children that run `module`; workers of other tests' servers are further down the tree."""
    found = []
    for child in psutil.Process().children():
        try:
            found += [process for process in (child, *child.children()) if module in process.cmdline()]
        except psutil.NoSuchProcess:
            continue
    # Each is the child of a keeper with the same command line, which starts first.
    keepers = {process.pid for process in found}
    return [process.pid for process in found if process.ppid() in keepers]


@pytest.fixture
def jobs(place: Path) -> Iterator[list[Rescoring | Filming]]:
    jobs = [Rescoring(place), Filming(place)]
    yield jobs
    for job in jobs:
        job.close()


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1], ids=["rescoring", "filming"])
def test_killing_one_of_two_processes_of_a_page_leaves_the_other(
    jobs: list[Rescoring | Filming], which: int
) -> None:
    killed, other = jobs[which], jobs[1 - which]
    held: dict[int, int] = {}
    for number, job in enumerate(jobs):
        job.start()
        (held[number],) = until(lambda job=job: job.pids(), "the process", seen=job.problem)
        # Stopped, so that both are in progress when one is killed.
        os.kill(held[number], signal.SIGSTOP)
    assert not killed.ended() and not other.ended()
    os.kill(held[which], signal.SIGKILL)
    until(killed.ended, "the end of the killed one")
    assert killed.problem().lower().startswith(f"{killed.process} was killed by sigkill")
    assert not other.ended()
    os.kill(held[1 - which], signal.SIGCONT)
    until(other.ended, "the end of the other")
    assert other.problem() == ""
    other.assert_right()
    killed.start()
    until(killed.ended, "the end of the next")
    assert killed.problem() == ""
    killed.assert_right()


# --- two commands ---------------------------------------------------------------------------------------


@contextmanager
def recording(folder: Path, name: str, seed: int) -> Iterator[subprocess.Popen[str]]:
    """``workbench record`` with a policy that waits for a go-ahead before its fourth step; killed if still running at the end."""
    (folder / f"{name}.py").write_text(POLICY.replace("NAME", name))
    command = [
        sys.executable,
        "-m",
        "workbench.cli.main",
        "record",
        "push.py",
        "--out",
        "out",
        "--seed",
        str(seed),
    ]
    command += ["--actions", f"{name}.py:act", "--episodes", "1", "--num-envs", "1", "--no-pictures"]
    command += ["--env", "render_backend=none"]
    process = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    with process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.slow
def test_killing_one_of_two_recorders_into_one_folder_leaves_the_other(tmp_path: Path) -> None:
    folder = tmp_path / "author"
    shutil.copytree(GOLDEN / "tasks" / "push", folder, ignore=shutil.ignore_patterns("__pycache__"))
    journals = folder / "out" / ".writing"
    with ExitStack() as ending:
        one, other = (ending.enter_context(recording(folder, *which)) for which in (("one", 9), ("other", 7)))
        until(lambda: (folder / "one.waits").exists() and (folder / "other.waits").exists(), "both")
        until(lambda: len(list(journals.glob("*.arrow"))) == 2, "both journals")
        time.sleep(FLUSH_SECONDS)
        one.kill()
        assert one.wait() == -signal.SIGKILL and other.poll() is None
        (folder / "other.may").touch()
        output, _ = other.communicate(timeout=EXIT_TIMEOUT_SECONDS)
        assert other.returncode == 0, output
        (path,) = (folder / "out").glob("*.json")
        assert_recorded(read_episode(path), "tagged", 8)
        assert len(list(journals.glob("*.arrow"))) == 1, "the killed recorder's journal is left for the next"

        (folder / "next.may").touch()
        third = ending.enter_context(recording(folder, "next", 6))
        output, _ = third.communicate(timeout=EXIT_TIMEOUT_SECONDS)
        assert third.returncode == 0 and re.search(r"recovered 1 episode\b", output)
    episodes = {episode.info.seed: episode for episode in map(read_episode, (folder / "out").glob("*.json"))}
    assert sorted(episodes) == [6, 7, 9] and not journals.exists()
    assert episodes[9].info.recovered and not episodes[6].info.recovered
    assert_recorded(episodes[9], "recovered", 3)


def assert_recorded(episode: Episode, kind: str, length: int) -> None:
    """Check that the episode equals the golden one of this kind (same seed and actions), or its beginning."""
    (path,) = (GOLDEN / "v1" / kind).glob("*.json")
    golden = read_episode(path)
    assert episode.length == length
    np.testing.assert_allclose(episode.reward, golden.reward[:length], atol=1e-3)
    np.testing.assert_array_equal(episode.action, golden.action[:length])
    for name, rows in golden.env_states.items():
        np.testing.assert_allclose(episode.env_states[name], rows[: length + 1], atol=1e-3)
