"""Jobs on a real Ray cluster with two nodes, both processes of this machine on its loopback address."""

from __future__ import annotations

import os
import re
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.jobs.work import Run, Setup
from workbench.episodes.reader.read_episode import read_episode
from workbench.jobs import ray_cluster as seam
from workbench.jobs.ray_cluster import Cluster
from workbench.jobs.ray_connection import connected
from workbench.jobs.results_file import JobFile, Kept, job_of
from workbench.jobs.scheduler import PoolError
from workbench.record.job import Recorded, record
from workbench.record.job_worker import RecordOptions
from workbench.task.description import TaskOptions

pytestmark = [pytest.mark.usefixtures("child_process"), pytest.mark.timeout(240), pytest.mark.slow]
PLAIN = {"render_backend": "none"}
TASK = """
from pathlib import Path

import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv

import beside

NUMBER = float((Path(__file__).parent / "assets" / "number.txt").read_text())


class Far(PushCubeEnv):
    def compute_dense_reward(self, obs, action, info):
        far = self.elapsed_steps > 3
        if beside.FAILS_BELOW is not None and (far & (self.obj.pose.p[:, 0] < beside.FAILS_BELOW)).any():
            raise RuntimeError("too near")
        return torch.full((self.num_envs,), NUMBER)
"""


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Address of a cluster with two nodes of one core each."""
    from ray.cluster_utils import Cluster as TwoNodes

    patch = pytest.MonkeyPatch()
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # socket paths must be short
    patch.setenv("RAY_TMPDIR", folder)
    patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    patch.setattr("ray._private.ray_constants.ENABLE_RAY_CLUSTER", False)
    patch.setenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    nodes = TwoNodes(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        nodes.add_node(num_cpus=1)
        nodes.wait_for_nodes()
        assert nodes.address is not None
        with connected(nodes.address):
            yield nodes.address
        nodes.shutdown()
    finally:
        patch.undo()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A task with a module and an asset beside it, in a subfolder of the current folder."""
    folder = tmp_path / "mine"
    (folder / "assets").mkdir(parents=True)
    (folder / "far.py").write_text(TASK)
    (folder / "beside.py").write_text("FAILS_BELOW = None\n")
    (folder / "assets" / "number.txt").write_text("0.25")
    (folder / "still.py").write_text("def act(obs):\n    return obs.new_zeros(len(obs), 8)\n")
    monkeypatch.chdir(tmp_path)
    return folder / "far.py"


def wanted(out: str, episodes: int = 8, **other: Any) -> RecordOptions:
    options = TaskOptions(num_envs=2, seed=3, env_kwargs=PLAIN)
    return RecordOptions(
        "mine/far.py",
        Path(out),
        episodes,
        pictures=False,
        max_steps=6,
        actions="mine/still.py:act",
        options=options,
        **other,
    )


def bits(recorded: Recorded) -> dict[int, bytes]:
    seeds = [one.seed for one in recorded.written]
    assert seeds == sorted(set(seeds))
    return {one.seed: one.path.with_suffix(".h5").read_bytes() for one in recorded.written}


def ray_workers() -> list[psutil.Process]:
    """Processes of actors that run a job."""
    return [
        one
        for one in psutil.process_iter(["cmdline"])
        if (one.info["cmdline"] or [""])[0] == "ray::RayWorker.run"
    ]


@pytest.mark.parametrize("workers", [1, 2])
def test_episodes_equal_local_ones_bit_for_bit_and_name_the_local_files(
    workers: int, address: str, task: Path
) -> None:
    here = record(wanted("here"))
    there = record(wanted("there"), executor=Cluster(address, workers))
    assert bits(there) == bits(here) and len(there.written) == 8
    ours, theirs = (read_episode(done.written[0].path).info for done in (here, there))
    assert (theirs.source_file, theirs.source_hash) == (ours.source_file, ours.source_hash)
    assert theirs.source == ours.source and theirs.side_files == ours.side_files
    assert theirs.acted_by == ours.acted_by
    assert {path.suffix for path in Path("there").iterdir()} == {".rrd", ".h5", ".json"}
    assert len(list(Path("there").iterdir())) == 24


def test_a_killed_worker_loses_and_duplicates_no_episode(
    address: str, task: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    here = bits(record(wanted("here")))
    killed = 0

    def kill(progress: Any) -> None:
        nonlocal killed
        if progress.over is not None and killed < 2:
            for process in ray_workers()[:1]:
                os.kill(process.pid, signal.SIGKILL)
                killed += 1

    there = record(wanted("there"), on_progress=kill, executor=Cluster(address, 2))
    assert killed == 2 and bits(there) == here and not there.failures
    ids = [read_episode(path).info.id for path in Path("there").glob("*.rrd")]
    assert len(ids) == len(set(ids)) == 8
    assert not (Path("there") / ".writing").exists()
    # Standard output is reserved for results such as JSON; Ray must not print there.
    assert not capfd.readouterr().out


def test_a_stopped_job_leaves_complete_episodes_and_is_resumed(address: str, task: Path) -> None:
    # So many that the stop, which is asked for at the end of the first, comes before that of the last.
    here, asked = bits(record(wanted("here", 64))), wanted("there", 64)
    over = threading.Event()

    def run(stop: Callable[[], bool], on_progress: Callable[[Any], None]) -> Recorded:
        file = JobFile(Path("part.job"), job_of("record", asked.task, asked, ("out",)))
        try:
            return record(
                asked,
                lambda text: None,
                on_progress,
                stop,
                executor=Kept(Cluster(address, 1), file),
                run=file.run,
            )
        finally:
            file.close()

    def on_progress(progress: Any) -> None:
        if progress.over is not None:
            over.set()

    first = run(over.is_set, on_progress)
    assert first.stopped and 0 < len(first.written) < 64
    assert len(list(Path("there").glob("*.json"))) == len(first.written)
    second = run(lambda: False, lambda progress: None)
    assert bits(second) == here and len(list(Path("there").glob("*.json"))) == 64


def test_failed_seeds_are_reported_with_the_local_line_and_the_others_are_kept(
    address: str, task: Path
) -> None:
    (task.parent / "beside.py").write_text("FAILS_BELOW = -0.05\n")
    done = record(wanted("there"), executor=Cluster(address, 2))
    assert done.failures and done.written
    failed = {number for failure in done.failures for number in failure.numbers}
    assert failed | {one.index for one in done.written} == set(range(8))
    problem = done.failures[0].problem
    assert (problem.file, problem.code) == (str(task), 'raise RuntimeError("too near")')
    assert "workbench-job" not in problem.traceback


def test_items_are_done_once_even_if_a_worker_dies(address: str, tmp_path: Path) -> None:
    run = Run(Setup("killed once", 4, folder=tmp_path), range(9), chunk=3, tries=3, goes_on=True)
    reports: list[str] = []
    run.run_with(Cluster(address, 2, on_death=reports.append))
    assert len(reports) == 1 and reports[0].startswith("a worker that squares has ended (")
    assert run.squares() == {number: number**2 for number in range(9)} and not run.failures
    pids = {result.pid for result in run.results.values()}
    # Finished items of the dead worker may be lost with it.
    assert os.getpid() not in pids and pids - {int((tmp_path / "killed").read_text())}


def test_other_versions_are_refused_and_named(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = seam.versions_here()
    monkeypatch.setattr(seam, "versions_here", lambda: {**here, "torch": "1.0"})
    with pytest.raises(PoolError, match=re.escape(f"has torch {here['torch']} (submitting side: 1.0)")):
        Run(Setup(folder=tmp_path), range(8)).run_with(Cluster(address, 1))


def test_a_folder_that_a_machine_does_not_see_is_refused(
    address: str, task: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Simulates a machine with its own folder of this name.
    monkeypatch.setattr(Path, "touch", lambda path: None)
    with pytest.raises(PoolError, match="does not share the folder .*there: give a folder that all machines"):
        record(wanted("there"), executor=Cluster(address, 1))
