"""Rules in the running workbench: reported with the author's file and line, by degree, and cleared by a fix."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.pose import Pose

from tests.drive.session import wait_until
from workbench.app.session import Session
from workbench.envs.action_vector import hold_action
from workbench.envs.gpu_rules import Finding
from workbench.episodes.reader.read_episode import read_episode
from workbench.live.commands import PauseRun, PlayRun
from workbench.live.messages import Event, Load, RulesBroken
from workbench.live.worker.reload import Running, load_version
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions
from workbench.task.description import TaskOptions
from workbench.task.open import OpenedTask, Opening, open_task
from workbench.task.problem import Problem, TaskError

pytestmark = pytest.mark.thorough

TASK = """
import torch
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.pose import Pose


@register_env("RulesOfATest-v1", max_episode_steps=50, override=True)
class PickCubeOfATest(PickCubeEnv):
{body}
"""
LOST = """
    def _before_control_step(self):
        self.lift()

    def lift(self):
        self.cube.set_pose(Pose.create_from_pq(torch.rand((self.num_envs, 3))))  # the fault
"""
BEHIND = """
    def _before_control_step(self):
        self.cube._objs[0].set_pose(self.cube.initial_pose.sp)  # the fault
"""
NEIGHBOURS_BEHIND = """
    def _initialize_episode(self, env_idx, options):
        super()._initialize_episode(env_idx, options)
        for entity in self.cube._objs:
            entity.set_pose(self.cube.initial_pose.sp)  # the fault
"""
SHRUNK = """
    def _initialize_episode(self, env_idx, options):
        super()._initialize_episode(env_idx, options)
        self.draw(env_idx)

    def draw(self, env_idx):
        self.target = torch.rand((len(env_idx), 3))  # the fault
"""
REWRITTEN = """
    def _initialize_episode(self, env_idx, options):
        super()._initialize_episode(env_idx, options)
        self.target = torch.rand((self.num_envs, 2))  # the fault
"""
REWARD = """
    def compute_dense_reward(self, obs, action, info):
        return super().compute_dense_reward(obs, action, info)[:, None]  # the fault
"""
STANDS = """
    def compute_normalized_dense_reward(self, obs, action, info):
        return {reward}  # the fault
"""
OBSERVATION = """
    def _get_obs_extra(self, info):
        return {"goal": self.goal_site.pose.p[0]}  # the fault
"""
KWARGS: dict[str, Any] = {"obs_mode": "state", "render_backend": "none"}


def opened(reference: str, rules: Any = None, found: list[Finding] | None = None) -> Iterator[OpenedTask]:
    options = TaskOptions(num_envs=4, backend="cpu", env_kwargs=KWARGS, rules=rules)
    reported: list[Finding] = [] if found is None else found
    task = open_task(reference, options, on_finding=reported.append)
    try:
        yield task
    finally:
        task.env.close()


def write(body: str, folder: Path) -> str:
    file = folder / "task.py"
    file.write_text(TASK.format(body=body))
    return str(file.resolve())


def problem_of(body: str, folder: Path, rules: Any = None) -> Problem:
    with pytest.raises(TaskError) as caught:
        for _ in opened(write(body, folder), rules):
            pass
    return caught.value.problem


@pytest.mark.parametrize(
    ("body", "stage", "words"),
    [
        (SHRUNK, "reset", "self.target now has rows for only 1 of"),
        (REWARD, "returns", "compute_dense_reward() returned a float32 tensor of shape (4, 1)"),
        (OBSERVATION, "returns", "_get_obs_extra() returned 'goal' as a float32 tensor of shape (3,)"),
    ],
)
def test_a_breach_that_stops_is_reported_at_the_authors_line(
    body: str, stage: str, words: str, tmp_path: Path
) -> None:
    """Changes to other envs, and values that ManiSkill or the page cannot use."""
    problem = problem_of(body, tmp_path)
    assert words in problem.message
    assert (problem.stage, problem.file) == (stage, str((tmp_path / "task.py").resolve()))
    assert "# the fault" in (problem.code or ""), problem


@pytest.mark.parametrize(
    ("body", "rule", "words"),
    [
        (LOST, "not-applied", "The pose of 'cube' in envs 0, 1, 2, 3"),
        (NEIGHBOURS_BEHIND, "behind-the-tensors", "Entity.set_pose()"),
        (REWRITTEN, "rows-rewritten", "self.target is changed in envs 1, 2, 3, which are not being reset"),
    ],
)
def test_a_breach_that_warns_is_a_row_and_the_task_opens(
    body: str, rule: str, words: str, tmp_path: Path
) -> None:
    file, findings = write(body, tmp_path), []
    for task in opened(file, found=findings):
        task.env.step(hold_action(task.env.parts, 4))
        rules = task.env.broken_rules
        assert rules is not None
        row = next(row for row in rules.rows if row.rule == rule)
        assert words in row.message and row.degree == "warn"
        assert row.file == file and "# the fault" in row.code and row.first_step == 0
        assert [finding.message for finding in findings] == [row.message for row in rules.rows]
        assert row.count > 1 or rule == "rows-rewritten", "a rule broken at every step is one row"


@pytest.mark.parametrize(
    ("reward", "kind"),
    [
        # UnitreeG1Stand-v1 in its sparse mode does this.
        ("torch.arange(self.num_envs) % 2 == 1", "bool"),
        ("(torch.arange(self.num_envs) % 2).to(torch.uint8)", "uint8"),
    ],
)
def test_an_integer_reward_opens_is_reported_and_is_recorded(
    child_process: None, reward: str, kind: str, tmp_path: Path
) -> None:
    """Stock ManiSkill passes it on, and so does `workbench.make`."""
    file, findings = write(STANDS.format(reward=reward), tmp_path), []
    options = TaskOptions(num_envs=2, backend="cpu", env_kwargs=KWARGS)
    wanted = RecordOptions(file, tmp_path / "out", 2, pictures=False, max_steps=3, options=options)
    recorded = record(wanted, on_finding=findings.append)
    (finding,) = findings
    assert (finding.rule, finding.degree, finding.file) == ("reward-rows", "warn", file)
    assert "# the fault" in finding.code and f"a {kind} tensor of shape (2,)" in finding.message
    assert ".float()" in finding.message, "the message must say what to write instead"
    episodes = [read_episode(episode.path) for episode in recorded.written]
    assert [episode.reward.tolist() for episode in episodes] == [[0.0] * 3, [1.0] * 3]
    with pytest.raises(TaskError, match=rf"returned a {kind} tensor"):
        next(opened(file, rules="stop"))


@pytest.mark.parametrize(
    ("body", "mode", "rule"),
    [
        (STANDS.format(reward="torch.zeros(1, 1)"), "normalized_dense", "reward-rows"),
        (
            """
    def evaluate(self):
        return {**super().evaluate(), "success": torch.zeros(1, 1) > 1}  # the fault
""",
            "none",
            "evaluate-flags",
        ),
    ],
)
def test_a_column_of_one_env_opens_and_is_reported_at_its_return(
    body: str, mode: str, rule: str, tmp_path: Path
) -> None:
    """Stock ManiSkill passes on such values of a single env; with several envs they are refused."""
    file, findings = write(body, tmp_path), []
    options = TaskOptions(num_envs=1, backend="cpu", env_kwargs={**KWARGS, "reward_mode": mode})
    open_task(file, options, on_finding=findings.append).env.close()
    finding = next(each for each in findings if each.rule == rule)
    assert (finding.degree, finding.file) == ("warn", file) and "# the fault" in finding.code
    assert "shape (1, 1)" in finding.message and "shape (1,)" in finding.message


@pytest.mark.parametrize("body", [LOST, BEHIND, REWRITTEN])
def test_rules_set_to_stop_stop_at_the_line(body: str, tmp_path: Path) -> None:
    problem = problem_of(body, tmp_path, rules="stop")
    assert "# the fault" in (problem.code or "") and "--rules warn" in problem.message


def test_an_installed_task_is_reported_and_stopped_only_on_request() -> None:
    @register_env("InstalledTaskOfATest-v1", override=True)
    class Lost(PickCubeEnv):
        def _before_control_step(self) -> None:
            self.cube.set_pose(Pose.create_from_pq(torch.rand((self.num_envs, 3))))

    findings: list[Finding] = []
    for _ in opened("InstalledTaskOfATest-v1", found=findings):
        pass
    assert any(
        "The pose of 'cube' in envs 0, 1, 2, 3 was set and not applied" in one.message for one in findings
    )
    with pytest.raises(TaskError, match="was set and not applied"):
        next(opened("InstalledTaskOfATest-v1", rules="stop"))


# --- an edited file ------------------------------------------------------------------------------------


class Desk:
    """An author's file and its running version."""

    def __init__(self, folder: Path, body: str) -> None:
        self.file = folder / "task.py"
        self._options = TaskOptions(num_envs=4, backend="cpu", env_kwargs=KWARGS)
        self._running: Running | None = None
        self.save(body)

    def save(self, body: str) -> str:
        self.file.write_text(TASK.format(body=body))
        request = Load(str(self.file), self._options)
        quiet = Opening(on_finding=lambda finding: None, begins_anew=True)
        opened, report = load_version(request, self._running, quiet)
        if self._running is not None and opened.env.env is not self.opened.env.env:
            self.opened.env.close()
        self._running = Running(request, opened, opened.first)
        return "first" if report is None else report.level

    @property
    def opened(self) -> OpenedTask:
        assert self._running is not None
        return self._running.opened

    def rows(self) -> list[Finding]:
        rules = self.opened.env.broken_rules
        assert rules is not None
        return list(rules.rows)

    def step(self) -> None:
        env = self.opened.env
        env.step(hold_action(env.parts, env.num_envs))

    def reset(self, env: int) -> None:
        self.opened.env.reset(env_idx=[env])


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    desk = Desk(tmp_path, LOST + REWRITTEN)
    yield desk
    desk.opened.env.close()


def rule_ids(desk: Desk) -> list[str]:
    return sorted(row.rule for row in desk.rows())


def test_a_row_follows_its_line_and_is_cleared_when_its_function_is_fixed(desk: Desk) -> None:
    assert rule_ids(desk) == ["not-applied", "rows-rewritten"]
    before = {row.rule: row for row in desk.rows()}
    fixed = REWRITTEN.replace("torch.rand((self.num_envs, 2))  # the fault", "None")
    assert desk.save("\n\n    # two lines and a comment\n" + LOST + fixed) == "patched"
    (row,) = desk.rows()
    assert row.rule == "not-applied" and row.line == (before["not-applied"].line or 0) + 3
    assert "# the fault" in row.code
    desk.step()
    assert desk.rows()[0].count == row.count + 1, "the same row with one more breach"
    desk.reset(2)
    assert rule_ids(desk) == ["not-applied"]


def test_a_row_fixed_elsewhere_is_cleared_at_the_next_check(desk: Desk) -> None:
    applies = LOST.replace(
        "        self.lift()\n",
        "        self.lift()\n        self.scene._gpu_apply_all()\n        self.scene._gpu_fetch_all()\n",
    )
    assert desk.save(applies + REWRITTEN) == "patched"
    assert rule_ids(desk) == ["not-applied", "rows-rewritten"]
    desk.step()
    assert rule_ids(desk) == ["rows-rewritten"]
    desk.reset(1)
    assert rule_ids(desk) == ["rows-rewritten"], "still broken"


def test_a_rejected_version_changes_no_row(desk: Desk) -> None:
    before = desk.rows()
    with pytest.raises(TaskError):
        desk.save(LOST + REWRITTEN + "\n    def evaluate(self):\n        return nothing_of_this_name\n")
    assert desk.rows() == before


# --- the page ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_page_keeps_the_mark_until_the_file_is_fixed(child_process: None, tmp_path: Path) -> None:
    file, events = tmp_path / "task.py", []
    counts = STANDS.format(reward="torch.arange(self.num_envs) % 2 == 1")
    file.write_text(TASK.format(body=LOST + counts))

    def note(event: Event) -> None:
        if isinstance(event, RulesBroken):
            events.append(event)

    session = Session(
        str(file),
        TaskOptions(num_envs=2, env_kwargs=KWARGS),
        recordings=tmp_path / "recordings",
        on_event=note,
    )
    try:
        view = wait_until(session, lambda view: view.rules is not None, "the mark")
        assert view.task is not None and view.problem is None, "the task is open"
        assert view.rules is not None
        row, reward = view.rules.rows
        assert row.rule == "not-applied" and Path(row.file or "").name == "task.py"
        assert reward.rule == "reward-rows"
        count = row.count
        session.do(PlayRun())
        wait_until(session, lambda view: bool(view.rules and view.rules.rows[0].count > count + 3), "a count")
        session.do(PauseRun())
        findings = [finding.rule for event in events for finding in event.new]
        assert findings == ["not-applied", "reward-rows"], "each rule is reported once"
        step = session.view().step
        assert step is not None and step.reward.tolist() == [0.0, 1.0], "True is drawn as 1"
        assert not any(re.search("RuleWarning", text) for text in session.view().printed.texts)
        file.write_text(TASK.format(body=LOST.replace("self.cube.set_pose", "len")))
        wait_until(session, lambda view: view.rules is None and view.task_serial == 2, "the end of the mark")
    finally:
        session.close()
