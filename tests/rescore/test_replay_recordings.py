"""Rescoring of recorded files, ours and those of ManiSkill's RecordEpisode, from code, terminal and page."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import csv
import itertools
import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
from mani_skill.utils.wrappers.record import RecordEpisode

from tests.drive.episodes import made, write
from tests.drive.session import rescored
from workbench.actions.choose import read_actions
from workbench.cli.arguments import JobArguments
from workbench.cli.main import main
from workbench.cli.rescore import RescoreOptions, rescore_all
from workbench.cli.share import export_in_terminal
from workbench.episodes.lerobot.export import ExportOptions
from workbench.episodes.reader.reading import find_all_sources
from workbench.episodes.row import UnreadableRecording
from workbench.jobs.pack_author_files import pack_worker_files, relocated
from workbench.jobs.scheduler import Scheduler, ThisProcess, Work
from workbench.live.timeline_commands import StopRescoring
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions
from workbench.rescore import verdict_text
from workbench.rescore.job import Recording, rescore_recordings, setup_of
from workbench.rescore.recording_jobs import Rescorer
from workbench.rescore.replay_recordings import RescoredBy, answer
from workbench.rescore.verdict import Rescore
from workbench.task.description import TaskOptions
from workbench.task.problem import TaskError
from workbench.trust.clearance import Clearances

pytestmark = pytest.mark.usefixtures("child_process")

TASKS = Path(__file__).parents[2] / "tasks"
TEXT = (TASKS / "push_cube.py").read_text()
REWARD = "return self.compute_dense_reward(obs, action, info) / 3"
STEPS, EPISODES = 12, 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the author's file and a folder of recordings."""
    folder = tmp_path_factory.mktemp("author")
    (folder / "push_cube.py").write_text(TEXT)
    options = TaskOptions(2, "cpu", 20, {"render_backend": "none"})
    out = folder / "recordings"
    record(
        RecordOptions(
            str(folder / "push_cube.py"),
            out,
            episodes=EPISODES,
            pictures=False,
            max_steps=STEPS,
            options=options,
        )
    )
    return folder


@pytest.fixture
def author(folder: Path) -> Path:
    """The same folder, with the file restored as recorded."""
    (folder / "push_cube.py").write_text(TEXT)
    return folder


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of a stock env, written by ManiSkill's own wrapper."""
    folder = tmp_path_factory.mktemp("foreign")
    env: Any = gym.make("PickCube-v1", obs_mode="state", reward_mode="dense", render_backend="none")
    env = RecordEpisode(env, str(folder), save_video=False, trajectory_name="demos", source_type="test")
    rng = np.random.default_rng(0)
    for seed in (6, 9):
        env.reset(seed=seed)
        for _ in range(STEPS):
            env.step(rng.uniform(-1, 1, 8).astype(np.float32))
    env.close()
    return folder / "demos.h5"


def edit(author: Path, old: str, new: str) -> None:
    assert old in TEXT
    (author / "push_cube.py").write_text(TEXT.replace(old, new))


@pytest.mark.slow
def test_no_recording_is_opened_in_this_process(
    author: Path, foreign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> None:
        raise AssertionError(f"{path} was opened here")

    for module in ("maniskill.read", "reader.read_episode"):
        monkeypatch.setattr(f"workbench.episodes.{module}.open_h5", refuse)
    assert len(rescore_all(RescoreOptions((foreign, author / "recordings")))[0]) == 5
    assert [run.length for run in read_actions(foreign)[0]] == [STEPS, STEPS]


def test_an_edited_reward_differs_by_the_edit_and_the_recorded_text_does_not(author: Path) -> None:
    edit(author, REWARD, f"{REWARD} + 0.25")
    files = tuple(sorted((author / "recordings").glob("*.rrd"))[:2])
    verdicts, _ = rescore_all(RescoreOptions(files))
    assert len(verdicts) == 2
    for verdict in verdicts:
        np.testing.assert_allclose(verdict.new_reward, verdict.old_reward + np.float32(0.25), rtol=1e-6)
        assert verdict.first_difference == 1 and verdict.largest == pytest.approx(0.25, rel=1e-5)
        assert verdict.returns[1] - verdict.returns[0] == pytest.approx(0.25 * STEPS, rel=1e-5)
    before = set(Path("/tmp").glob("workbench-recorded-*"))
    verdicts, _ = rescore_all(RescoreOptions(files, recorded_source=True))
    assert [verdict.differs for verdict in verdicts] == [False, False]
    assert set(Path("/tmp").glob("workbench-recorded-*")) <= before


def test_a_file_of_record_episode_is_rescored_with_the_env_that_it_names(foreign: Path) -> None:
    found = find_all_sources((foreign,))
    assert [source.part for source in found] == ["traj_0", "traj_1"]
    for use_env_states in (False, True):
        verdicts, _ = rescore_all(RescoreOptions((foreign.parent,), use_env_states=use_env_states))
        assert [verdict.seed for verdict in verdicts] == [6, 9]
        for verdict in verdicts:
            # A stock env and a batched one differ in the last bits.
            assert verdict.why_not == "" and verdict.metres is not None and verdict.metres < 1e-4
            assert verdict.success == (None, None) and not verdict.drifted
            np.testing.assert_allclose(verdict.new_reward, verdict.old_reward, atol=1e-3)


@pytest.mark.slow
def test_a_lerobot_dataset_is_skipped_and_refused_if_alone(author: Path, tmp_path: Path) -> None:
    write(tmp_path / "made", made(6, seed=1), pictures=False)
    dataset = tmp_path / "set"
    assert export_in_terminal([tmp_path / "made"], dataset, ExportOptions()) == 0
    assert {source.kind for source in find_all_sources([dataset])} == {"lerobot"}
    with pytest.raises(UnreadableRecording, match="LeRobot dataset cannot be rescored"):
        rescore_all(RescoreOptions((dataset,)))
    verdicts, _ = rescore_all(RescoreOptions((dataset, author / "recordings")))
    assert len(verdicts) == EPISODES and not any(verdict.why_not for verdict in verdicts)


def test_a_broken_recording_is_a_row_and_the_others_are_rescored(author: Path, tmp_path: Path) -> None:
    for file in (author / "recordings").iterdir():
        shutil.copy(file, tmp_path)
    broken, cut, _ = sorted(tmp_path.glob("*.rrd"))
    for file in (broken, broken.with_suffix(".h5"), cut):
        file.write_bytes(file.read_bytes()[:1000])
    verdicts, _ = rescore_all(RescoreOptions((tmp_path,), task=str(author / "push_cube.py")))
    # The parts of the second recording that rescoring needs are intact.
    assert [bool(verdict.why_not) for verdict in verdicts] == [True, False, False]
    assert broken.stem in verdicts[0].why_not


# --- by several workers ------------------------------------------------------------------------------

DIES_ONCE = (
    (
        "import numpy as np\n",
        "import os\nimport signal\nfrom pathlib import Path\n\nimport numpy as np\n\n"
        "MARK, CALLS = Path(__file__).with_name('died'), []\n",
    ),
    (
        REWARD,
        "CALLS.append(1)\n        if len(CALLS) == 20 and not MARK.exists():\n            MARK.touch()\n"
        f"            os.kill(os.getpid(), signal.SIGKILL)\n        {REWARD} + 0.25",
    ),
)


def comparable(verdicts: list[Any]) -> list[Any]:
    return [
        (row, verdict.new_reward.tolist(), verdict.old_reward.tolist())
        for row, verdict in zip(verdict_text.as_rows(verdicts), verdicts, strict=True)
    ]


@pytest.mark.slow
def test_any_number_of_workers_gives_equal_verdicts_even_if_one_is_killed(
    author: Path, foreign: Path, tmp_path: Path
) -> None:
    """One recording per chunk: recordings of two tasks, and one that cannot be read."""
    for file in author.glob("recordings/*seed0021*"):
        (tmp_path / file.name).write_bytes(file.read_bytes()[:100])
    text = TEXT
    for old, new in DIES_ONCE:
        assert old in text
        text = text.replace(old, new)
    (author / "push_cube.py").write_text(text)
    mark = author / "died"
    mark.touch()
    what = RescoreOptions((author / "recordings", *tmp_path.glob("*.rrd"), foreign), num_envs=1)
    trusted = Clearances(all_trusted=True)
    alone, _ = rescore_all(what, clearances=trusted)
    assert [bool(verdict.why_not) for verdict in alone] == [False, False, False, True, False, False]
    assert [verdict.differs for verdict in alone] == [True, True, True, False, False, False]
    mark.unlink()
    for workers in (2, 1):
        verdicts, _ = rescore_all(
            what, clearances=trusted, run=JobArguments(workers=workers, job=tmp_path / f"{workers}.job")
        )
        assert comparable(verdicts) == comparable(alone)
    assert mark.exists(), "one worker must have died"
    mark.unlink()
    activities: list[str] = []
    again = JobArguments(job=tmp_path / "2.job")
    verdicts, _ = rescore_all(what, activities.append, clearances=trusted, run=again)
    assert comparable(verdicts) == comparable(alone) and activities == [], "all chunks were already done"


def test_an_episode_in_which_the_code_raises_is_a_row_and_the_others_are_rescored(author: Path) -> None:
    """The job continues: the next chunk gets new envs."""
    raises = "assert 21 not in self._episode_seed.tolist(), 'not this one'\n        "
    edit(author, REWARD, raises + REWARD)
    verdicts, _ = rescore_all(RescoreOptions((author / "recordings",), num_envs=1))
    assert ["not this one" in verdict.why_not for verdict in verdicts] == [False, True, False]
    assert not any(verdict.differs for verdict in verdicts)


def test_each_verdict_is_sent_once_however_often_progress_is_reported(
    author: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = itertools.count()
    monkeypatch.setattr(
        "workbench.rescore.replay_recordings.time", SimpleNamespace(monotonic=lambda: next(clock))
    )
    files, parts = find_all_sources((author / "recordings",)), []
    options = TaskOptions(1, env_kwargs={"render_backend": "none"})
    question = Rescore(str(author / "push_cube.py"), options, options, tuple(files), False)
    parts.append(answer(question, lambda done, total, part: parts.append(part)))
    names = [verdict.of.name for part in parts for verdict in part.verdicts]
    assert sorted(names) == sorted(file.name for file in files) and len(parts) > EPISODES


class StoringExecutor:
    """An executor that stores its work and does it in this process."""

    is_remote = True
    work: Work[Any, Any, Any]

    def run(self, work: Work[Any, Any, Any], scheduler: Scheduler[Any, Any]) -> None:
        self.work = work
        ThisProcess().run(work, scheduler)


def test_recordings_travel_to_other_machines_unless_they_are_large(
    author: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are copied with the folder of the task. Large recordings are read from their own path."""
    shutil.copytree(author, tmp_path / "author")
    task = str(tmp_path / "author" / "push_cube.py")
    paths = sorted((tmp_path / "author" / "recordings").glob("*.rrd"))[:1]
    (source,) = find_all_sources(paths)
    options = TaskOptions(1, "cpu", 20, {"render_backend": "none"})
    code = RescoredBy(task, options, options)
    recording = Recording(0, bytes(source.path), None, source.part, source.id, source.name)
    setup = setup_of([(code, [recording])], 1, use_env_states=False)

    executor = StoringExecutor()
    (result,) = rescore_recordings(setup, executor)
    assert not result.verdict.why_not and result.verdict.of == source
    assert {file.suffix for file in executor.work.files} == {".rrd", ".h5", ".json"}
    assert list(executor.work.folders) == [tmp_path / "author"]
    assert executor.work.setup.items[0].travels == source.path
    # Recordings beside the task are not part of its folder's copy; they are copied separately.
    worker_files = pack_worker_files(executor.work.folders, executor.work.files)
    (tmp_path / "there").mkdir()
    here = Path.cwd()
    places = worker_files.unpack(tmp_path / "there")
    os.chdir(here)
    assert relocated(source.path, places).is_file() and len(places) == 1

    monkeypatch.setattr("workbench.rescore.job.MAX_BYTES", 0)
    (result,) = rescore_recordings(setup, executor)
    assert not result.verdict.why_not and list(executor.work.files) == []
    assert executor.work.setup.items[0].travels is None
    (tmp_path / "author" / "recordings").rename(tmp_path / "gone")
    with pytest.raises(FileNotFoundError, match="does not see the recordings in .*, which are too large"):
        executor.run(executor.work, Scheduler([0], lambda number, result: None))


# --- in the terminal ---------------------------------------------------------------------------------


def run(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(["rescore", *arguments])
    printed = capsys.readouterr()
    return int(ended.value.code or 0), printed.out, printed.err


def test_the_command_prints_a_table_and_writes_it(
    author: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(author, REWARD, f"{REWARD} * 2")
    tables = [tmp_path / "out.csv", tmp_path / "out.json"]
    recordings = str(author / "recordings")
    code, out, _ = run([recordings, "--csv-file", str(tables[0]), "--json-file", str(tables[1])], capsys)
    assert code == 0 and f"{EPISODES} of {EPISODES} episodes differ" in out
    rows = list(csv.DictReader(tables[0].open()))
    assert [row["seed"] for row in rows] == ["20", "21", "22"]
    from_json = json.loads(tables[1].read_text())
    assert all(row["return_now"] == pytest.approx(2 * row["return_before"], rel=1e-5) for row in from_json)
    assert all(row["first_difference"] == 1 and row["drift_metres"] == 0 for row in from_json)


def test_output_for_programs_contains_nothing_else(author: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(author, REWARD, f"print('printed by the task')\n        {REWARD}")
    code, out, err = run([str(author / "recordings"), "--json"], capsys)
    assert code == 0 and [row["seed"] for row in json.loads(out)] == [20, 21, 22]
    assert "printed by the task" in err
    code, out, _ = run([str(author / "recordings"), "--csv"], capsys)
    assert code == 0 and [row["seed"] for row in csv.DictReader(out.splitlines())] == ["20", "21", "22"]


def test_a_broken_task_is_reported_with_its_line(author: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(author, REWARD, "return self.nonsense(obs)")
    code, _, err = run([str(author / "recordings")], capsys)
    line = TEXT[: TEXT.index(REWARD)].count("\n") + 1
    assert code == 1 and f"push_cube.py:{line}" in err and "nonsense" in err
    with pytest.raises(TaskError):
        rescore_all(RescoreOptions((author / "recordings",)))


@pytest.mark.slow
def test_merged_parts_print_the_same_as_the_whole(
    author: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    edit(author, REWARD, f"{REWARD} + 0.25")
    few = [str(author / "recordings"), "--num-envs", "1"]
    code, whole, _ = run([*few, "--workers", "1", "--json-file", "whole.json"], capsys)
    assert code == 0
    for part in ("1/2", "2/2"):
        code, _, err = run([*few, "--workers", "1", "--shard", part], capsys)
        assert code == 0 and f"Part {part} is in rescore-{part[0]}-of-2.job" in err
    with pytest.raises(SystemExit) as ended:
        main(["merge", "rescore-1-of-2.job", "rescore-2-of-2.job", "--json-file", "merged.json"])
    assert ended.value.code == 0 and capsys.readouterr().out == whole
    assert (tmp_path / "merged.json").read_text() == (tmp_path / "whole.json").read_text()
    with pytest.raises(SystemExit) as ended:
        main(["merge", "rescore-2-of-2.job"])
    assert ended.value.code == 1
    assert "of the job's recordings are in none of these files" in capsys.readouterr().out
    edit(author, REWARD, f"{REWARD} + 0.5")
    code, _, err = run([*few, "--shard", "1/2"], capsys)
    assert code == 2 and "belongs to another job: code is" in err


# --- for a page ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_page_rescores_in_a_subprocess_and_stops_it(author: Path, foreign: Path) -> None:
    rescorer = Rescorer()
    try:
        edit(author, REWARD, f"{REWARD} * 2")
        rescorer.start(find_all_sources((author / "recordings",)))
        view = rescored(rescorer, "done", "failed")
        assert view.why == "" and len(view.verdicts) == view.total == EPISODES
        assert view.steps == EPISODES * STEPS and all(verdict.differs for verdict in view.verdicts)
        assert verdict_text.summary(view.verdicts).startswith("3 of 3 episodes differ")

        edit(author, REWARD, "return 1 / 0")
        rescorer.start(find_all_sources((author / "recordings",)))
        view = rescored(rescorer, "failed", "done")
        assert "cannot be opened" in view.why and "ZeroDivisionError" in view.problem.message
        rescorer.start(find_all_sources((author / "recordings", foreign)))
        view = rescored(rescorer, "done", "failed")
        assert view.state == "done"
        assert ["ZeroDivisionError" in v.why_not for v in view.verdicts] == [True] * EPISODES + [False] * 2
        rescorer.start(find_all_sources((author / "recordings",)), recorded_source=True)
        view = rescored(rescorer, "done", "failed")
        assert view.why == "" and not any(verdict.differs for verdict in view.verdicts)

        edit(author, REWARD, "import time; time.sleep(1000)")
        rescorer.start(find_all_sources((author / "recordings",)))
        rescored(rescorer, "loading")
        rescorer.do(StopRescoring())
        rescored(rescorer, "stopped")
    finally:
        rescorer.close()
