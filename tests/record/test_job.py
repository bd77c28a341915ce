"""``workbench record``: equal episodes with any number of envs and processes, from any source of actions."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.waiting import until
from tests.episodes.verify_rrd import verify_rrd
from workbench.cli.record import record_in_terminal
from workbench.episodes.episode import Episode
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.recorded_source import options_of
from workbench.jobs.local_processes import Processes
from workbench.jobs.scheduler import Executor, Scheduler, Work
from workbench.record.job import Recorded, RecordProgress, record
from workbench.record.job_worker import RecordOptions, Written
from workbench.task.description import TaskOptions
from workbench.task.problem import TaskError

pytestmark = pytest.mark.usefixtures("child_process")

TASKS = Path(__file__).parents[2] / "tasks"
PUSHER = Path(__file__).parents[1] / "browser" / "pusher.py"
PLAIN = {"render_backend": "none"}

PUSHED = {"control_mode": "pd_ee_delta_pos", **PLAIN}


def read_all(recorded: Recorded) -> list[Episode]:
    return [read_episode(episode.path) for episode in recorded.written]


def assert_same(one: Episode, other: Episode) -> None:
    """Assert that two episodes are equal, bit for bit."""
    assert one.info.seed == other.info.seed
    np.testing.assert_array_equal(one.action, other.action)
    np.testing.assert_array_equal(one.reward, other.reward)
    assert one.env_states.keys() == other.env_states.keys() and one.env_states
    for name, values in one.env_states.items():
        np.testing.assert_array_equal(values, other.env_states[name], err_msg=name)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Three short episodes of random actions on two envs, without pictures."""
    seen: list[RecordProgress] = []
    out = tmp_path_factory.mktemp("recorded")
    options = TaskOptions(num_envs=2, seed=10)
    done = record(
        RecordOptions("PushCube-v1", out, 3, pictures=False, max_steps=5, options=options),
        on_progress=seen.append,
    )
    assert [episode.steps for episode in done.written] == [5, 5, 5]
    assert (seen[-1].steps, done.tried, done.stopped) == (15, 3, False)
    return done


def test_every_episode_is_three_self_contained_files(recorded: Recorded) -> None:
    for episode in recorded.written:
        assert verify_rrd(episode.path) is None
        files = sorted(episode.path.parent.glob(f"{episode.path.stem}.*"))
        assert [file.suffix for file in files] == [".h5", ".json", ".rrd"]
    read = read_all(recorded)
    assert read[0].info.acted_by == ((0, "random"),) and read[0].info.pictures == "exact"
    assert {"articulations/panda", "actors/cube"} <= read[0].env_states.keys()
    assert read[0].obs["agent/qpos"].shape == (6, 9)
    assert read[0].info.env_kwargs == {
        "obs_mode": "state",
        "reward_mode": "normalized_dense",
        "control_mode": "pd_joint_delta_pos",
    }


def test_an_episode_starts_like_the_stock_env_with_its_seed(recorded: Recorded) -> None:
    stock: Any = gym.make("PushCube-v1", num_envs=1, obs_mode="state", render_backend="none").unwrapped
    for seed, episode in zip((10, 11, 12), read_all(recorded), strict=True):
        assert episode.info.seed == seed
        stock.reset(seed=seed)
        np.testing.assert_allclose(
            episode.env_states["actors/cube"][0], stock.obj.get_state()[0].numpy(), atol=1e-6
        )
    stock.close()


@pytest.mark.parametrize(
    ("num_envs", "workers", "executor"),
    [
        (1, 1, None),
        pytest.param(1, 1, Processes(1), marks=pytest.mark.slow),
        pytest.param(1, 3, None, marks=pytest.mark.slow),
        (3, 1, None),
    ],
)
def test_the_episodes_are_the_same_on_any_number_of_envs_and_processes(
    recorded: Recorded, num_envs: int, workers: int, executor: Executor | None, tmp_path: Path
) -> None:
    options = TaskOptions(num_envs=num_envs, seed=10, env_kwargs=PLAIN)
    what = RecordOptions(
        "PushCube-v1", tmp_path, 3, pictures=False, max_steps=5, workers=workers, options=options
    )
    again = record(what, executor=executor)
    for one, other in zip(recorded.written, again.written, strict=True):
        assert_same(read_episode(one.path), read_episode(other.path))
        assert one.path.with_suffix(".h5").read_bytes() == other.path.with_suffix(".h5").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2, 4])
def test_killed_processes_lose_and_duplicate_no_episode(workers: int, tmp_path: Path) -> None:
    policy = tmp_path / "act.py"
    policy.write_text(
        "import torch\n\ntorch.manual_seed(0)\nlayer = torch.nn.Linear(35, 8)\n\n\n"
        "def act(obs):\n    return torch.tanh(layer(obs)).detach()\n"
    )
    options = TaskOptions(num_envs=3, env_kwargs=PLAIN)
    what = RecordOptions(
        *("PushCube-v1", tmp_path / "here", 13),
        actions=f"{policy}:act",
        pictures=False,
        max_steps=5,
        options=options,
    )
    here = record(what)
    killed: set[int] = set()

    def kill(progress: RecordProgress) -> None:
        for child in psutil.Process().children(recursive=True) if len(killed) < 2 else ():
            with suppress(psutil.Error):  # the process may have ended meanwhile
                words = child.cmdline()
                if progress.over and "workbench.jobs.local_processes" in words and child.children() == []:
                    child.kill()
                    killed.add(child.pid)
                    return

    there = record(replace(what, out=tmp_path / "there", workers=workers), on_progress=kill)
    assert len(killed) == 2 and not there.failures
    for one, other in zip(here.written, there.written, strict=True):
        assert one.path.with_suffix(".h5").read_bytes() == other.path.with_suffix(".h5").read_bytes()
    assert len(list((tmp_path / "there").iterdir())) == 3 * 13


def test_an_episode_does_not_depend_on_those_before_it_in_its_process(tmp_path: Path) -> None:
    """Bodies touch in this task: contacts cached by PhysX would change the last bits."""
    task = str(Path(__file__).parents[2] / "tasks" / "broken" / "reach_ball.py")
    kwargs = {**PLAIN, "control_mode": "pd_ee_delta_pose"}
    found = {}
    for first, count in ((1, 2), (2, 1)):
        options = TaskOptions(num_envs=1, seed=first, env_kwargs=kwargs)
        what = RecordOptions(
            task, tmp_path / str(first), count, pictures=False, max_steps=12, options=options
        )
        found[first] = read_episode(record(what).written[-1].path)
    assert found[1].info.seed == found[2].info.seed == 2
    assert_same(found[1], found[2])


class RandomOrderExecutor:
    """An executor whose episodes end in a drawn order, with empty files."""

    def __init__(self, good: list[bool], slots: int, data: st.DataObject) -> None:
        self.good, self.slots, self.data = good, slots, data
        self.is_remote = False

    def run(self, work: Work, scheduler: Scheduler) -> None:
        (what,) = work.setup.wanted
        running: list[int] = []
        while True:
            running = [number for number in running if number < scheduler.limit()]
            while len(running) < self.slots and (chunk := scheduler.next("a worker")) is not None:
                running += chunk.numbers
            if not running:
                return
            number = running.pop(self.data.draw(st.integers(0, len(running) - 1)))
            path = what.out / f"v1.{number}.rrd"
            if self.good[number] or what.successes is None:
                for suffix in (".rrd", ".h5", ".json"):
                    path.with_suffix(suffix).touch()
                scheduler.result("a worker", number, Written(number, path, number, 1, 0.0, self.good[number]))
            else:
                scheduler.result("a worker", number, None)


@given(
    wanted=st.integers(1, 5),
    tries=st.integers(1, 40),
    good=st.lists(st.booleans(), min_size=40, max_size=40),
    slots=st.integers(1, 8),
    data=st.data(),
)
def test_successes_with_the_lowest_numbers_are_kept(
    wanted: int, tries: int, good: list[bool], slots: int, data: st.DataObject
) -> None:
    first = [index for index in range(tries) if good[index]][:wanted]
    seen: list[RecordProgress] = []
    with tempfile.TemporaryDirectory() as folder:
        what = RecordOptions("PushCube-v1", Path(folder), successes=wanted, tries=tries)
        done = record(what, on_progress=seen.append, executor=RandomOrderExecutor(good, slots, data))
        left = sorted(path.name for path in Path(folder).iterdir())
    assert [episode.index for episode in done.written] == first
    assert left == sorted(f"v1.{number}{suffix}" for number in first for suffix in (".rrd", ".h5", ".json"))
    assert done.tried == (first[-1] + 1 if len(first) == wanted else tries)
    assert max(progress.kept for progress in seen) <= wanted


def test_only_successes_are_kept(tmp_path: Path) -> None:
    lazy = tmp_path / "lazy.py"
    lazy.write_text(
        f"{PUSHER.read_text()}\n\ndef lazy(obs):\n    move = act(obs)\n    move[3] = 0.0\n    return move\n"
    )
    options = TaskOptions(num_envs=5, env_kwargs=PUSHED)
    what = RecordOptions(
        str(TASKS / "push_cube.py"),
        tmp_path / "out",
        successes=4,
        pictures=False,
        actions=f"{lazy}:lazy",
        options=options,
    )
    done = record(what)
    assert [episode.index for episode in done.written] == [0, 1, 2, 4]
    assert done.tried == 5
    assert all(bool(episode.evaluate["success"][-1]) for episode in read_all(done))
    assert read_all(done)[0].info.acted_by == ((0, f"policy {lazy}:lazy"),)
    assert len(list((tmp_path / "out").iterdir())) == 12


def test_actions_from_a_file_are_played_to_its_end(recorded: Recorded, tmp_path: Path) -> None:
    actions = [episode.action for episode in read_all(recorded)]
    np.savez(tmp_path / "actions.npz", *actions)
    what = RecordOptions(
        "PushCube-v1",
        tmp_path / "out",
        actions=str(tmp_path / "actions.npz"),
        pictures=False,
        options=TaskOptions(num_envs=2, seed=10, env_kwargs=PLAIN),
    )
    for index, (one, other) in enumerate(zip(read_all(recorded), read_all(record(what)), strict=True)):
        assert_same(one, other)
        assert other.info.acted_by == ((0, f"file actions.npz, its array {index}"),)


@pytest.mark.parametrize("use_env_states", [False, True])
def test_demonstrations_are_replayed_from_their_own_seeds(
    recorded: Recorded, use_env_states: bool, tmp_path: Path
) -> None:
    demonstration = recorded.written[1].path.with_suffix(".h5")
    what = RecordOptions(
        "PushCube-v1",
        tmp_path,
        actions=str(demonstration),
        use_env_states=use_env_states,
        pictures=False,
        options=TaskOptions(num_envs=2, env_kwargs=PLAIN),
    )
    done = record(what)
    (replayed,) = read_all(done)
    assert done.start_corrected == 0
    assert_same(replayed, read_all(recorded)[1])
    ((begins, source),) = replayed.info.acted_by
    assert begins == 0 and demonstration.name in source


def test_pictures_of_every_camera_are_recorded_with_their_kind(renderer: None, tmp_path: Path) -> None:
    options = TaskOptions(num_envs=1)
    task = str(TASKS / "push_cube.py")
    what = RecordOptions(task, tmp_path, 1, fast_pictures=True, max_steps=2, options=options)
    (episode,) = read_all(record(what))
    assert episode.info.pictures == "fast"
    assert options_of(episode.info, 1).pictures == "fast", "it must be rescored with the same kind"
    cameras = {track.info.name: track for track in episode.cameras}
    assert {"base_camera", "render_camera"} <= cameras.keys()
    assert len(cameras["base_camera"].frame) == 3
    depth = cameras["base_camera"].depth
    assert depth is not None and depth[0].shape == (128, 128)


@pytest.mark.slow
def test_a_task_that_fails_while_recording_says_where(tmp_path: Path) -> None:
    broken = tmp_path / "broken.py"
    text = (TASKS / "minimal.py").read_text()
    broken.write_text(text + "\n\nraise RuntimeError('not today')\n")
    for workers in (1, 2):
        what = RecordOptions(
            str(broken), tmp_path / "out", workers=workers, options=TaskOptions(num_envs=workers)
        )
        with pytest.raises(TaskError, match="not today"):
            record(what)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def failing_policy(tmp_path: Path) -> RecordOptions:
    """Options for two episodes of three steps; the policy raises in the second one."""
    (tmp_path / "tires.py").write_text(
        "asked = 0\n\n\ndef act(obs):\n    global asked\n    asked += 1\n"
        "    if asked > 4:\n        raise RuntimeError('tired')\n    return obs.new_zeros(len(obs), 8)\n"
    )
    policy = f"{tmp_path}/tires.py:act"
    options = TaskOptions(num_envs=1, env_kwargs=PLAIN)
    return RecordOptions(
        "PushCube-v1", tmp_path / "out", 2, actions=policy, pictures=False, max_steps=3, options=options
    )


def test_a_failed_episode_is_no_longer_in_progress(failing_policy: RecordOptions) -> None:
    progress: list[RecordProgress] = []
    record(failing_policy, on_progress=progress.append)
    assert any(1 in now.running for now in progress)
    last = progress[-1]
    assert [list(failure.numbers) for failure in last.failures] == [[1]]
    assert last.running == {} and last.done == last.kept == 1


def test_episodes_kept_before_a_failure_are_reported(
    failing_policy: RecordOptions, capsys: pytest.CaptureFixture
) -> None:
    assert record_in_terminal(failing_policy) == 1
    printed = capsys.readouterr()
    assert "policy failed" in printed.err and "tired" in printed.err
    assert "1 item without a result: episode 1" in printed.err
    assert "1 episode recorded, 1 without a result" in printed.err
    assert "Look at them with: workbench review" in printed.out


DRAWS = """
import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv


class Draws(PushCubeEnv):
    def _initialize_episode(self, env_idx, options):
        super()._initialize_episode(env_idx, options)
        self.target = torch.rand((self.num_envs, 2))
"""


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_broken_rule_is_reported_once_with_any_number_of_processes(workers: int, tmp_path: Path) -> None:
    file, found = tmp_path / "draws.py", []
    file.write_text(DRAWS)
    # A process needs two envs for a partial reset.
    options = TaskOptions(num_envs=2 * workers, env_kwargs=PLAIN)
    what = RecordOptions(
        str(file), tmp_path / "out", 4, pictures=False, max_steps=2, workers=workers, options=options
    )
    assert len(record(what, on_finding=found.append).written) == 4
    assert [(finding.rule, finding.line) for finding in found] == [("rows-rewritten", 9)]
    off = replace(what, options=replace(options, rules="off"))
    assert len(record(off, on_finding=found.append).written) == 4 and len(found) == 1


def test_a_file_with_the_name_of_a_library_is_reported_once_in_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = Path(shutil.copy(TASKS / "minimal.py", tmp_path))
    (tmp_path / "numpy.py").write_text("")
    options = TaskOptions(num_envs=1, env_kwargs=PLAIN)
    what = RecordOptions(str(file), tmp_path / "out", 1, pictures=False, max_steps=2, options=options)
    assert record_in_terminal(what) == 0
    assert capsys.readouterr().err.count(str(tmp_path / "numpy.py")) == 1


@pytest.mark.slow
def test_a_second_ctrl_c_ends_processes_that_hang(tmp_path: Path) -> None:
    (tmp_path / "hangs.py").write_text(
        "from pathlib import Path\n\nasked = 0\n\n\n"
        "def act(obs):\n    global asked\n    asked += 1\n"
        "    while asked > 3:\n        Path('hung').touch()\n    return obs.new_zeros(8)\n"
    )
    command = [
        *(
            sys.executable,
            "-m",
            "workbench.cli.main",
            "record",
            "PushCube-v1",
            "--no-pictures",
            "--out",
            "out",
        ),
        *("--env", "render_backend=none"),
        *("--num-envs", "1", "--workers", "2", "--actions", "hangs.py:act"),
    ]
    process = subprocess.Popen(
        command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    until(lambda: (tmp_path / "hung").exists() or process.poll() is not None, "the loop")
    for _ in range(2):
        time.sleep(0.5)  # the first signal must be handled, or both merge into one
        os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130 and "interrupted" in errors
    assert "Traceback" not in errors


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
def test_ctrl_c_keeps_finished_episodes(workers: str, tmp_path: Path) -> None:
    command = [
        *(sys.executable, "-m", "workbench.cli.main", "record", "PushCube-v1", "--no-pictures"),
        *("--env", "render_backend=none"),
        *("--episodes", "100000", "--max-steps", "3", "--num-envs", "2", "--workers", workers),
        *("--out", str(tmp_path)),
    ]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    until(lambda: list(tmp_path.glob("*.json")) or process.poll() is not None, "the first episode")
    os.killpg(process.pid, signal.SIGINT)  # a terminal signals the process group too
    stdout, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and "interrupted" in errors
    assert "Traceback" not in errors
    written = sorted(tmp_path.glob("*.json"))
    assert len(stdout.splitlines()) == len(written) + 1
    counted = re.findall(
        r"^episode (\d+): 3 steps, return -?[\d.]+, no success, (\d+) of 100000 kept$", errors, re.M
    )
    assert [int(kept) for _, kept in counted] == list(range(1, len(written) + 1)), (
        "in a pipe, each episode prints a line"
    )
    assert not (tmp_path / ".writing").exists()
    assert all(verify_rrd(path.with_suffix(".rrd")) is None for path in written[-2:])
