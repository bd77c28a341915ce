"""``workbench sweep`` runs each seed once per point, records the changed source, and does not depend on the number of workers."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from workbench.cli.sweep import parse_settings
from workbench.episodes.reader.read_episode import read_episode
from workbench.jobs.local_processes import Processes
from workbench.jobs.scheduler import Executor
from workbench.planning.options import PlanOptions
from workbench.record.job import RecordProgress
from workbench.record.job_worker import Written
from workbench.sweep.job import (
    MAX_POINTS,
    Setting,
    SweepOptions,
    SweepReport,
    collect_sweep,
    recordings_of,
    sweep,
)
from workbench.task.description import TaskOptions
from workbench.task.problem import TaskError
from workbench.task.settings_in_text import SettingError

pytestmark = pytest.mark.usefixtures("child_process")

REWARD_TERMS = Path(__file__).parents[2] / "tasks" / "reward_terms.py"
PLAIN = {"render_backend": "none"}


def options(
    out: Path, *given: str, seeds: int = 3, task: Path = REWARD_TERMS, num_envs: int = 2
) -> SweepOptions:
    made = TaskOptions(num_envs=num_envs, seed=5, env_kwargs=PLAIN)
    return SweepOptions(str(task), parse_settings(given), out, seeds, max_steps=3, options=made)


def numbers(report: SweepReport) -> list[object]:
    """Return the results without the recordings' names, which differ by run."""
    return [replace(row, recording="") for row in report.results.episodes]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sweep")


@pytest.fixture(scope="module")
def swept(out: Path) -> SweepReport:
    reports: list[RecordProgress] = []
    report = sweep(options(out, "MOST=5,1", "control_mode=pd_ee_delta_pos,nix"), on_progress=reports.append)
    over = [progress.over for progress in reports if progress.over is not None]
    last = reports[-1]
    assert (last.kept, last.done, last.running) == (6, 6, {})
    assert sorted(number for failure in last.failures for number in failure.numbers) == [4, 5, 6, 12, 13, 14]
    assert sorted(written.seed for _, written in over if written is not None) == [5, 5, 6, 6, 7, 7], (
        "every episode must be reported"
    )
    return report


def test_each_seed_is_recorded_once_for_each_point(swept: SweepReport, out: Path) -> None:
    rows = swept.results.episodes
    assert [(row.point, row.seed) for row in rows] == [(p, s) for p in range(4) for s in (5, 6, 7)]
    assert swept.missing == 0 and not swept.stopped
    assert [failure.numbers for failure in swept.failures]
    recorded = [row for row in rows if row.recording]
    assert [row.point for row in recorded] == [0, 0, 0, 2, 2, 2]
    for row in recorded:
        episode = read_episode(out / row.recording)
        assert episode.info.seed == row.seed and episode.length == row.steps == 3
        assert episode.means == row.means and "reward_terms/reach" in row.means


def test_a_recording_holds_the_source_that_ran_and_the_file_is_unchanged(
    swept: SweepReport, out: Path
) -> None:
    before = REWARD_TERMS.read_text()
    texts = {}
    for row in swept.results.episodes:
        if row.recording:
            (texts[row.point],) = read_episode(out / row.recording).info.source.values()
    assert texts == {0: before, 2: before.replace("MOST = 5.0", "MOST = 1.0")}
    # The changed source ran: MOST normalizes the reward.
    first, other = swept.results.episodes[0], swept.results.episodes[6]
    assert first.total_reward is not None and other.total_reward is not None
    assert other.total_reward == pytest.approx(5 * first.total_reward, rel=1e-5)


def test_a_point_that_cannot_be_built_fails_in_its_rows_and_the_others_run(swept: SweepReport) -> None:
    failed = [row for row in swept.results.episodes if row.failure]
    assert [row.point for row in failed] == [1, 1, 1, 3, 3, 3]
    assert all("nix" in row.failure and row.success is None for row in failed)
    best, *_, last = swept.results.summaries()
    assert best.values == {"MOST": "1", "control_mode": '"pd_ee_delta_pos"'} and best.rate == 0
    assert (last.episodes, last.failed, last.rate) == (0, 3, None)


def test_a_sweep_without_a_result_fails_and_a_stopped_one_says_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(TaskError):
        sweep(options(tmp_path / "fails", "control_mode=nix,nex", seeds=1))
    stopped = sweep(options(tmp_path / "stopped", "MOST=1,2"), stop=lambda: True)
    assert stopped.stopped and stopped.missing == 6 and stopped.results.episodes == ()


@pytest.mark.slow
@pytest.mark.parametrize("executor", [Processes(2), Processes(4)])
def test_the_numbers_are_the_same_on_any_number_of_workers(
    swept: SweepReport, executor: Executor, tmp_path: Path
) -> None:
    what = options(tmp_path, "MOST=5,1", "control_mode=pd_ee_delta_pos,nix")
    assert numbers(sweep(what, executor=executor)) == numbers(swept)


class KillOnce:
    """Progress callback that sends SIGKILL to a worker after the first episode."""

    def __init__(self) -> None:
        self.done = False

    def __call__(self, progress: RecordProgress) -> None:
        if progress.over is not None and not self.done:
            self.done = True
            workers = [
                one
                for one in psutil.Process().children(recursive=True)
                if "workbench" in " ".join(one.cmdline()) and not one.children()
            ]
            os.kill(workers[0].pid, signal.SIGKILL)


@pytest.mark.slow
def test_a_killed_worker_changes_no_number(swept: SweepReport, tmp_path: Path) -> None:
    killer = KillOnce()
    what = options(tmp_path, "MOST=5,1", "control_mode=pd_ee_delta_pos,nix")
    again = sweep(what, on_progress=killer, executor=Processes(2))
    assert killer.done and numbers(again) == numbers(swept)
    recordings = [row.recording for row in again.results.episodes if row.recording]
    assert sorted(recordings) == sorted(str(file.relative_to(tmp_path)) for file in tmp_path.glob("*/*.rrd"))


# --- settings ---------------------------------------------------------------------------------------

SEVERAL = """
import math
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import register_env
from weights import REACH

SCALE = 2
LIMITS = (0.1, 0.2)
ANGLE = math.pi / 2
NAME = "cube"
TWICE = 1
if NAME:
    TWICE = 2
weight = 1.0


class Base(BaseEnv):
    SCALE = 3

    def __init__(self, *args, weight=1.0, goals=2, **kwargs):
        super().__init__(*args, **kwargs)


@register_env("Swept-v1")
class Swept(Base):
    GAIN: float = 0.5  # of the controller

    def __init__(self, *args, goals=3, tall=False, **kwargs):
        super().__init__(*args, goals=goals, **kwargs)


class Other(BaseEnv):
    GAIN = 1.0
    NOTHING = None
    ONE = (1,)
    FLAGS = [True, "a"]
    FREE = {"a": 1}

    def __init__(self, robot_uids="panda", *, only=1):
        super().__init__(robot_uids=robot_uids)
"""


@pytest.fixture
def several(tmp_path: Path) -> Path:
    (tmp_path / "several.py").write_text(SEVERAL)
    return tmp_path / "several.py"


def changed(file: Path, given: str, task: str = "") -> tuple[dict[str, object], str, str]:
    """Return the only point's env arguments and its changed line, old and new. The file is never run."""
    (recording,) = recordings_of(replace(options(file.parent, given), task=task or str(file)))
    (text,) = recording.source.values()
    pairs = zip(SEVERAL.splitlines(), text.splitlines(), strict=True)
    old, new = next(((old, new) for old, new in pairs if old != new), ("", ""))
    given_kwargs = {name: value for name, value in recording.options.env_kwargs.items() if name not in PLAIN}
    return given_kwargs, old, new


def test_a_constant_is_changed_with_the_smallest_edit(several: Path) -> None:
    assert changed(several, "LIMITS=[1, 0.5]") == ({}, "LIMITS = (0.1, 0.2)", "LIMITS = (1.0, 0.5)")
    assert changed(several, "NAME=ball") == ({}, 'NAME = "cube"', "NAME = 'ball'")
    assert changed(several, "several.SCALE=4") == ({}, "SCALE = 2", "SCALE = 4")
    assert changed(several, "Base.SCALE=4") == ({}, "    SCALE = 3", "    SCALE = 4")
    gain = "    GAIN: float = 0.5  # of the controller", "    GAIN: float = 2.0  # of the controller"
    assert changed(several, "Swept.GAIN=2") == ({}, *gain)
    assert changed(several, "GAIN=2", f"{several}:Swept") == ({}, *gain)


def test_a_value_is_written_in_the_type_that_it_had(several: Path) -> None:
    for given, new in (
        ("NOTHING=3", "NOTHING = 3"),
        ("GAIN=null", "GAIN = None"),
        ("ONE=[2]", "ONE = (2,)"),
        ("ONE=[2,3]", "ONE = (2, 3)"),
        ('FLAGS=[false,"b","c"]', "FLAGS = [False, 'b', 'c']"),
        ('FREE={"b":2}', "FREE = {'b': 2}"),
    ):
        (name, value) = given.split("=")
        what = replace(options(several.parent, "a=1"), task=f"{several}:Other")
        (recording,) = recordings_of(
            replace(what, settings=(Setting(f"Other.{name}", (json.loads(value),)),))
        )
        (text,) = recording.source.values()
        assert f"    {new}\n" in text, given
    for given in ("FLAGS=[1]", "FREE=[1]", "GAIN=true", "GAIN=a", "ONE=1", "only=1"):
        if given == "only=1":
            assert changed(several, given, f"{several}:Other")[0] == {"only": 1}
            continue
        with pytest.raises(SettingError):
            changed(several, f"Other.{given}", f"{several}:Other")
    with pytest.raises(SettingError):
        changed(several, "tall=true", f"{several}:Other")


def test_any_name_may_be_an_argument_if_a_base_class_is_not_found(tmp_path: Path) -> None:
    file = tmp_path / "odd.py"
    file.write_text("from nowhere import Base\n\n\nclass Odd(Base):\n    SIZE = 1\n")
    for given, kwargs in (("anything=2", {"anything": 2}), ("SIZE=2", {})):
        (one,) = recordings_of(replace(options(tmp_path, given), task=str(file)))
        assert one.options.env_kwargs == {**PLAIN, **kwargs}
    (tmp_path / "kit").mkdir()
    (tmp_path / "kit" / "base.py").write_text("class Base:\n    def __init__(self, far=1, **kwargs): pass\n")
    for line in ("from kit.base import Base", "import kit.base as b", "import kit.base"):
        base = {"import kit.base as b": "b.Base", "import kit.base": "kit.base.Base"}.get(line, "Base")
        file.write_text(f"{line}\n\n\nclass Odd({base}):\n    pass\n")
        (one,) = recordings_of(replace(options(tmp_path, "far=2"), task=str(file)))
        assert one.options.env_kwargs["far"] == 2


def test_a_constructor_argument_is_passed_to_the_env(several: Path) -> None:
    assert changed(several, "tall=true") == ({"tall": True}, "", "")
    assert changed(several, "control_mode=pd_joint_pos") == ({"control_mode": "pd_joint_pos"}, "", "")
    assert changed(several, "Swept.__init__.weight=2") == ({"weight": 2}, "", "")


def test_every_option_reaches_the_recording_of_each_point(several: Path) -> None:
    made = replace(options(several.parent, "Swept.GAIN=1,2", "tall=true,false", seeds=7), pictures=True)
    made = replace(made, actions="solve", plan=PlanOptions(rollouts=17), upload="s3://bucket/x/")
    recordings = recordings_of(replace(made, task=str(several)))
    assert [one.out for one in recordings] == [several.parent / point.folder for point in made.points]
    assert len({one.out for one in recordings}) == 4
    for point, one in zip(made.points, recordings, strict=True):
        assert (one.episodes, one.max_steps, one.actions, one.plan.rollouts) == (7, 3, "solve", 17)
        assert one.pictures and one.after_success > 0 and one.upload == f"s3://bucket/x/{point.folder}"
        assert one.options == replace(made.options, env_kwargs={**PLAIN, "tall": point.values["tall"]})
        assert list(one.source.values()) == [
            SEVERAL.replace("0.5  # of", f"{point.values['Swept.GAIN']}.0  # of")
        ]
    plain = recordings_of(replace(made, task=str(several), actions="random", upload="", pictures=False))
    assert [(one.after_success, one.upload, one.pictures) for one in plain] == [(0, "", False)] * 4


def test_an_id_of_maniskill_takes_arguments_of_its_constructor(tmp_path: Path) -> None:
    (one,) = recordings_of(replace(options(tmp_path, "robot_uids=fetch"), task="PickCube-v1"))
    assert one.options.env_kwargs == {**PLAIN, "robot_uids": "fetch"} and one.source == {}
    for setting in ("robot_uidss=fetch", "SIZE=1"):
        with pytest.raises(SettingError):
            recordings_of(replace(options(tmp_path, setting), task="PickCube-v1"))
    # Registered by a module of --import, which is not imported here: its arguments are unknown.
    (one,) = recordings_of(replace(options(tmp_path, "anything=1"), task="Unknown-v1"))
    assert one.options.env_kwargs["anything"] == 1


def test_a_request_that_makes_no_sense_is_refused(several: Path) -> None:
    def refused(error: type[Exception] = ValueError, *given: str, **changes: object) -> None:
        what = replace(options(several.parent, *(given or ("tall=true",))), task=str(several))
        recordings_of(what)
        with pytest.raises(error):
            recordings_of(replace(what, **changes))

    refused(seeds=0)
    refused(settings=(Setting("Swept.GAIN", (1.0,) * (MAX_POINTS + 1)),))
    refused(SettingError, options=TaskOptions(env_kwargs={"tall": False}))
    np.save(several.parent / "given.npy", np.zeros((3, 8), np.float32))
    refused(actions=str(several.parent / "given.npy"))
    recordings_of(replace(options(several.parent, "Swept.GAIN=1"), task=str(several), options=TaskOptions(env_kwargs={"tall": False})))  # fmt: skip


def test_results_have_the_seed_and_the_point_of_each_episode(several: Path) -> None:
    what = replace(options(several.parent, "Swept.GAIN=1,2", seeds=3, num_envs=4), task=str(several))
    assert what.chunk == what.stride == 4
    known: dict[int, Written | None] = {}
    for number, success, solved_at in ((0, True, 2), (2, False, 1), (4, None, None), (5, False, None)):
        path = several.parent / f"e{number}.rrd"
        known[number] = Written(number, path, 0, 9, float(number), success, solved_at=solved_at, means={"a": number})  # fmt: skip
    known[6] = None
    report = collect_sweep(what, known)
    rows = {(row.point, row.seed): row for row in report.results.episodes}
    assert list(rows) == [(0, 5), (0, 7), (1, 5), (1, 6), (1, 7)]
    first, second = (point.folder for point in what.points)
    found = [(row.success, row.success_at_end, row.solved_at, row.total_reward) for row in rows.values()]
    assert found == [
        (True, True, 2, 0.0),
        (True, False, 1, 2.0),
        (None, None, None, 4.0),
        (False, False, None, 5.0),
        (None, None, None, None),
    ]
    recordings = [row.recording for row in rows.values()]
    assert recordings == [f"{first}/e0.rrd", f"{first}/e2.rrd", f"{second}/e4.rrd", f"{second}/e5.rrd", ""]
    assert [(row.steps, row.means) for row in rows.values()][:2] == [(9, {"a": 0}), (9, {"a": 2})]
    assert report.missing == 1 and not report.stopped and report.failures == ()


def test_folders_of_points_are_distinct_short_and_sorted_like_the_points(tmp_path: Path) -> None:
    values = tuple(f"{'x' * 90}/../ {k}" for k in range(12))
    points = replace(options(tmp_path, "a=1"), settings=(Setting("C.a", values),)).points
    folders = [point.folder for point in points]
    assert sorted(folders) == folders and len(set(folders)) == 12
    assert all(len(folder) < 90 and "/" not in folder and " " not in folder for folder in folders)


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ("SCALE=4", "SCALE of several.py may be Base.SCALE or several.SCALE: give one of these names"),
        ("weight=4", "weight of several.py may be Swept.__init__.weight or several.weight: give one"),
        ("talll=true", "did you mean tall?"),
        ("parts.HERE=1", "only constants of this file can be set, not those of modules that it imports"),
        ("ANGLE=1", "ANGLE (line 9 of several.py) is computed, `math.pi / 2`"),
        ("TWICE=3", "several.TWICE is set in several lines of several.py: 11, 13"),
        ("REACH=1", "several.REACH (line 5 of several.py) is imported"),
        ("LIMITS=3", "several.LIMITS is a list (line 8); got 3"),
        ("several.SCALE=true", "several.SCALE is a number (line 7); got True"),
    ],
)
def test_a_name_that_cannot_be_set_is_refused_with_a_reason(several: Path, given: str, why: str) -> None:
    with pytest.raises(ValueError, match=".") as refused:
        changed(several, given)
    assert why in str(refused.value)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("a=0.5,1,2", (0.5, 1, 2)),
        ("a=[0, 1],[1, 2]", ([0, 1], [1, 2])),
        ("a=panda,fetch", ("panda", "fetch")),
        ('a="x,y",z', ('"x', 'y"', "z")),
        ('a="x,y","z"', ("x,y", "z")),
        ("C.a=true,null", (True, None)),
        ("a=x=1", ("x=1",)),
    ],
)
def test_values_are_json_or_text(text: str, values: tuple[object, ...]) -> None:
    (setting,) = parse_settings([text])
    assert setting.values == values


def test_chunks_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    what = options(tmp_path, "MOST=1,2,3", seeds=100, num_envs=4)
    assert replace(what, workers=7).chunk == what.chunk == 8
    assert what.stride == 104 and len(what.items) == 300 and what.items[100] == 104
    many = replace(what, settings=(Setting("MOST", tuple(range(200))),))
    assert many.chunk == 100, "with many points, a chunk is a whole point"
    some = replace(what, settings=(Setting("MOST", tuple(range(40))),))
    assert some.chunk == 64, "about 64 chunks of all envs"
