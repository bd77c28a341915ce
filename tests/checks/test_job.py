"""The job of ``workbench check``: equal results with any number of processes, and results for a task that raises."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mani_skill.utils import assets

from workbench.checks.job import CheckReport, check, report_of
from workbench.checks.job_items import CheckOptions, ItemOutcome
from workbench.checks.results import RuleResult, merged
from workbench.checks.rule_table import RULES
from workbench.envs.gpu_rules import Finding
from workbench.jobs.local_processes import Processes
from workbench.jobs.results_file import JobFile, Kept, job_of, read_parts
from workbench.jobs.scheduler import Shard, ThisProcess
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions
from workbench.task.description import TaskOptions
from workbench.task.problem import TaskError

pytestmark = pytest.mark.thorough

TEXT = (Path(__file__).parents[2] / "tasks" / "push_cube.py").read_text()
AT_ONCE = '"success": (distance < GOAL_RADIUS)', '"success": (distance < 1)'
LOSES_ROWS = "b = len(env_idx)\n", "b = len(env_idx)\n            self.drawn = torch.rand((b, 2))\n"
RAISES = '"cube_height": height,', '"cube_height": height / self.gone,'
PLAIN = {"render_backend": "none"}
TURNED = (
    '"success": (distance < GOAL_RADIUS) & (height.abs() < 0.005),',
    '"success": self.agent.robot.qpos[:, 0] > 0.6,',
)
"""Success that random actions do not reach, but the largest actions reach in about twenty steps."""


def task_of(folder: Path, *edits: tuple[str, str]) -> str:
    text = TEXT
    for old, new in edits:
        assert old in text, old
        text = text.replace(old, new)
    file = folder / "task.py"
    file.write_text(text)
    return str(file)


def options(task: str, *select: str, workers: int = 1, ignore: tuple[str, ...] = ()) -> CheckOptions:
    made = TaskOptions(num_envs=4, env_kwargs=PLAIN)
    return CheckOptions(task, made, seeds=4, select=select, ignore=ignore, workers=workers)


def states(report: CheckReport) -> dict[str, str]:
    return {result.rule: result.state for result in report.results}


@pytest.mark.slow
def test_results_are_in_the_order_of_the_table_with_any_number_of_workers(
    tmp_path: Path, child_process: None
) -> None:
    """The first two rules are in different groups; the last is observed while these groups run."""
    task = task_of(tmp_path, AT_ONCE, LOSES_ROWS)
    rules = ("reward-finite", "success-at-reset", "rows-lost")
    seen: list[str] = []
    alone = check(options(task, *rules), on_result=lambda result: seen.append(result.rule))
    assert seen == ["success-at-reset", "reward-finite", "rows-lost"], (
        "progress is reported in order of completion"
    )
    several = check(options(task, *rules, workers=2), executor=Processes(2))
    assert states(alone) == states(several) and list(states(alone)) == [r for r in RULES if r in rules]
    assert states(alone) == {"rows-lost": "broken", "success-at-reset": "broken", "reward-finite": "kept"}
    comparable = [(finding.key, finding.message, finding.degree, finding.line) for finding in alone.findings]
    assert comparable == [(one.key, one.message, one.degree, one.line) for one in several.findings]
    # The notices name ids that other tests of this process have registered.
    assert replace(alone.task, notices=()) == replace(several.task, notices=())
    assert alone.task.env_id == "WorkbenchPushCube-v1"
    for report in (alone, several):
        assert report.fails("stop") and 0 < report.start_seconds < report.seconds


def test_a_gpu_rule_is_checked_alone(tmp_path: Path) -> None:
    report = check(options(task_of(tmp_path, LOSES_ROWS), "rows-lost"))
    (finding,) = report.findings
    assert finding.degree == "stop" and finding.code == "self.drawn = torch.rand((b, 2))"
    assert states(check(options(task_of(tmp_path), "rows-lost"))) == {"rows-lost": "not_applicable"}
    drawn = (
        "            self.drawn = self.drawn if hasattr(self, 'drawn') else torch.rand((self.num_envs, 2))\n"
    )
    keeps = LOSES_ROWS[0], f"{LOSES_ROWS[0]}{drawn}"
    assert states(check(options(task_of(tmp_path, keeps), "rows-lost"))) == {"rows-lost": "kept"}


def test_a_task_that_raises_breaks_one_rule_and_leaves_the_others_undecided(tmp_path: Path) -> None:
    task = task_of(tmp_path, RAISES)
    report = check(options(task, "runs", "reward-finite", "success-at-reset", "rows-lost"))
    assert states(report) == {
        "rows-lost": "not_known", "runs": "broken", "success-at-reset": "not_known", "reward-finite": "not_known"
    }  # fmt: skip
    (finding,) = report.findings
    assert (
        "self.gone" in finding.code
        and finding.rule == "runs"
        and "gone" in report.of_state("not_known")[0].why
    )


def test_seeds_begin_at_the_requested_one_in_all_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.checks.job_items.SEEDS_OF_PART", 4)
    made, steps = TaskOptions(num_envs=4, env_kwargs=PLAIN, seed=50), list[int]()
    task = task_of(tmp_path, AT_ONCE, LOSES_ROWS)
    what = CheckOptions(
        task, made, seeds=6, select=("success-at-reset", "outside-reach", "rows-lost"), workers=1
    )
    seen: list[str] = []
    report = check(what, seen.append, on_progress=steps.append)
    (success,) = [one for one in report.findings if one.rule == "success-at-reset"]
    assert success.count == 6 and "6 of 6 seeds (seed 50, 51, 52, 53, 54 ...)" in success.message
    assert states(report) == {"rows-lost": "broken", "success-at-reset": "broken", "outside-reach": "kept"}
    assert steps == [1, 2, 3, 4, 5] and any("part 2 of 2" in text for text in seen)
    assert (
        report.task.source == {task: Path(task).read_text()} and report.task.env_id == "WorkbenchPushCube-v1"
    )


def test_a_policy_acts_in_an_episode_of_each_seed_and_its_error_is_not_the_tasks(tmp_path: Path) -> None:
    short = "max_episode_steps=50", "max_episode_steps=22"
    task, policy = task_of(tmp_path, TURNED, short), tmp_path / "policy.py"
    act = "def act(obs):\n    import torch\n    action = torch.zeros((len(obs), 8))\n    action[:, 0] = 1\n    return action\n"
    policy.write_text(act)
    what = replace(options(task, "success-stays-possible", "runs"), actions=f"{policy}:act")
    report = check(what)
    assert notes(report)["success-stays-possible"][1:] == ("success in 4 of 4 given episodes",)
    policy.write_text(act.replace("= 1", "= gone"))
    report = check(what)
    (result,) = report.of_state("not_known")
    assert (
        result.rule == "success-stays-possible" and "gone" in result.why and states(report)["runs"] == "kept"
    )
    with pytest.raises(TaskError):
        check(replace(what, actions=f"{policy}:gone"))


def test_a_stopped_job_returns_its_results_so_far(tmp_path: Path) -> None:
    seen: list[RuleResult] = []
    rules = "success-at-reset", "reward-finite"
    report = check(options(task_of(tmp_path), *rules), on_result=seen.append, stop=lambda: bool(seen))
    assert report.stopped and states(report) == {"success-at-reset": "kept"}


def test_a_task_that_cannot_be_imported_or_lacks_a_download_is_not_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken.py").write_text("import nothing_of_this_name\n")
    with pytest.raises(TaskError, match="broken.py:1: ModuleNotFoundError"):
        check(options(str(tmp_path / "broken.py")))
    monkeypatch.setattr(assets, "is_data_source_downloaded", lambda name: name != "ycb")
    with pytest.raises(TaskError, match="mani_skill.utils.download_asset ycb"):
        check(options("PickSingleYCB-v1", "runs"))


def test_results_of_several_processes_for_one_rule_are_merged() -> None:
    finding = Finding("runs", "stop", "step: it raised", "a.py", 3, "x()", "evaluate", 1, 0)
    other = Finding("runs", "stop", "reset: it raised", "a.py", 9, "y()", "reset", 1, 0)
    again = Finding("runs", "stop", "step: it raised", "a.py", 3, "x()", "evaluate", 4, 0)
    one = merged(
        [
            RuleResult("runs", "kept", seconds=1.0, notes=("a",)),
            RuleResult("runs", "broken", (finding,), seconds=0.5),
            RuleResult("runs", "broken", (other, again), notes=("a", "b")),
        ]
    )
    assert one == RuleResult("runs", "broken", (again, other), notes=("a", "b"), seconds=1.5)
    undecided = [RuleResult("runs", "kept"), RuleResult("runs", "failed", why="it raised")]
    assert merged(undecided).state == "failed" and merged(undecided).why == "it raised"
    (of_other_seeds,) = merged(
        [RuleResult("runs", "broken", (finding,)), RuleResult("runs", "broken", (again,))], other_seeds=True
    ).findings
    assert of_other_seeds.count == 5


# --- many seeds: several parts, on any worker -------------------------------------------------------------

DIES_ONCE = (
    (
        "import numpy as np\n",
        "import os\nimport signal\nfrom pathlib import Path\n\nimport numpy as np\n\n"
        "MARK, RESETS = Path(__file__).with_name('died'), []\n",
    ),
    (
        "        with torch.device(self.device):\n            b = len(env_idx)\n",
        "        RESETS.append(1)\n        if len(RESETS) == 6 and not MARK.exists():\n            MARK.touch()\n"
        "            os.kill(os.getpid(), signal.SIGKILL)\n"
        "        with torch.device(self.device):\n            b = len(env_idx)\n",
    ),
)


def parts(task: str) -> CheckOptions:
    """Options for 40 seeds: parts of 32 and 8. The rules are in three groups; the last checks only the first part."""
    made = TaskOptions(num_envs=8, env_kwargs=PLAIN, seed=100)
    return CheckOptions(task, made, seeds=40, select=("outside-reach", "success-at-reset", "body-names"))


def comparable(report: CheckReport) -> object:
    """A report without its durations."""
    return (
        [replace(result, seconds=0.0) for result in report.results],
        replace(report.task, notices=()),
        report.comments,
        report.missing,
    )


@pytest.mark.slow
def test_many_seeds_give_equal_results_with_any_number_of_workers_and_deaths(
    tmp_path: Path, child_process: None
) -> None:
    task = task_of(tmp_path, AT_ONCE, *DIES_ONCE)
    mark = tmp_path / "died"
    mark.touch()
    steps: list[int] = []
    alone = check(parts(task), on_progress=steps.append)
    assert steps == [1, 2, 3, 4, 5]
    assert states(alone) == {"body-names": "kept", "outside-reach": "kept", "success-at-reset": "broken"}
    (finding,) = alone.findings
    assert finding.count == 40 and "of 40 of 40 seeds (seed 100, 101, 102, 103, 104 ...)" in finding.message
    mark.unlink()
    for workers in (1, 2):
        several = check(parts(task), executor=Processes(workers))
        assert comparable(several) == comparable(alone)
    assert mark.exists(), "one worker must have died"


@pytest.mark.slow
def test_parts_of_a_job_are_merged_and_a_job_is_resumed(tmp_path: Path) -> None:
    task = task_of(tmp_path, AT_ONCE)
    what = parts(task)
    whole = check(what)
    files = [tmp_path / "1.job", tmp_path / "2.job"]
    for number, path in enumerate(files, 1):
        file = JobFile(path, job_of("check", task, what, ("workers",)))
        part = check(what, executor=Kept(ThisProcess(), file, Shard(number, 2)))
        assert part.missing == (2, 3)[number - 1]
        file.close()
    kept = read_parts(files)
    assert comparable(report_of(what, kept.results(ItemOutcome))) == comparable(whole)

    file = JobFile(files[0], job_of("check", task, what, ("workers",)))
    seen: list[str] = []
    again = check(what, on_activity=seen.append, executor=Kept(ThisProcess(), file))
    file.close()
    assert comparable(again) == comparable(whole)
    assert [text for text in seen if "part 1" in text] == [] and "seeds, part 2 of 2: success" in seen


# --- given actions besides random ones --------------------------------------------------------------------


def turns(steps: int) -> np.ndarray:
    """Actions (steps, 8) that turn the first joint at full speed."""
    actions = np.zeros((steps, 8), np.float32)
    actions[:, 0] = 1
    return actions


def notes(report: CheckReport) -> dict[str, tuple[str, ...]]:
    return {result.rule: result.notes for result in report.results}


def test_actions_from_a_file_reach_states_that_random_actions_do_not(tmp_path: Path) -> None:
    """A single array is tried from each seed; several arrays each from one seed, at most as many as there are seeds."""
    task = task_of(tmp_path, TURNED)
    np.save(tmp_path / "one.npy", turns(20))
    np.savez(tmp_path / "two.npz", turns(20), turns(3))
    for name, reached in (("one.npy", "4 of 4"), ("two.npz", "1 of 2")):
        what = replace(options(task, "success-stays-possible"), actions=str(tmp_path / name))
        assert notes(check(what))["success-stays-possible"] == (
            "success in 0 of 4 random episodes",
            f"success in {reached} given episodes",
        )
    np.savez(tmp_path / "many.npz", *[turns(20)] * 6)
    what = replace(options(task, "success-stays-possible"), actions=str(tmp_path / "many.npz"))
    assert "4 of 4 given" in notes(check(what))["success-stays-possible"][1]


@pytest.mark.slow
def test_a_replayed_recording_begins_with_its_own_seed(tmp_path: Path, child_process: None) -> None:
    """Its seed is not one of the check's seeds, and it succeeds at its last step."""
    task = task_of(tmp_path, TURNED)
    np.save(tmp_path / "one.npy", turns(20))
    made = RecordOptions(
        task,
        tmp_path / "made",
        episodes=1,
        actions=str(tmp_path / "one.npy"),
        pictures=False,
        options=TaskOptions(num_envs=1, seed=70, env_kwargs=PLAIN),
    )
    (written,) = record(made).written
    assert written.success
    what = replace(options(task, "success-stays-possible"), actions=str(written.path.with_suffix(".h5")))
    assert notes(check(what))["success-stays-possible"][1] == "success in 1 of 1 given episode"


def test_a_task_that_runs_with_one_env_only_is_checked_with_one(tmp_path: Path) -> None:
    """It queries contacts, which works with one env only, and only in a step, after several envs were already used."""
    hook = next(line for line in TEXT.splitlines() if "def compute_dense_reward" in line)
    task = task_of(tmp_path, (hook, f"{hook}\n        self.scene.px.get_contacts()"))
    report = check(
        options(task, "success-at-reset", "runs", "reward-finite", "same-for-any-batch", "one-env-only")
    )
    assert states(report) == {
        "success-at-reset": "kept",
        "reward-finite": "kept",
        "runs": "not_known",
        "same-for-any-batch": "not_known",
        "one-env-only": "broken",
    }
    assert {finding.code for finding in report.findings} == {"self.scene.px.get_contacts()"}
