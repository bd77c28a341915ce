"""Groups of rules that a worker checks: progress, what is skipped, and which version the evidence is of."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from tests.checks.checked import EXAMPLE
from workbench.checks.questions import CheckedGroup, CheckGroup, RuleProgress
from workbench.checks.results import RuleResult
from workbench.checks.rule_table import RULES
from workbench.checks.run_rules import DECLARED, GROUPS
from workbench.checks.worker import WorkerChecks
from workbench.envs.gpu_rules import Degree
from workbench.live.messages import CannotAnswer
from workbench.task.description import TaskOptions
from workbench.task.load import LoadedTask, load_task, undo_load
from workbench.task.open import OpenedTask

pytestmark = pytest.mark.thorough

OPTIONS = TaskOptions(env_kwargs={"render_backend": "none"})
PLACE = {group: number for number, group in enumerate(DECLARED)} | {"GPU simulation": len(DECLARED)}


def opened(loaded: LoadedTask, num_envs: int) -> OpenedTask:
    return cast(OpenedTask, SimpleNamespace(loaded=loaded, env=SimpleNamespace(num_envs=num_envs)))


@pytest.fixture
def versions(tmp_path: Path) -> Iterator[list[LoadedTask]]:
    """Two versions of a task: the second one does not support its own robot."""
    made = []
    for name, robots in (("one", '["panda", "fetch"]'), ("two", '["fetch"]')):
        file = tmp_path / f"{name}.py"
        file.write_text(EXAMPLE.read_text().replace('["panda", "fetch"]', robots))
        made.append(load_task(str(file)))
    yield made
    for loaded in reversed(made):
        undo_load(loaded)


class Asked:
    """A worker, and what it answered and reported."""

    def __init__(self, checks: WorkerChecks, *rules: str) -> None:
        self.checks = checks
        self.degrees: dict[str, Degree] = {rule: "stop" if rule in rules else "off" for rule in RULES}
        self.progress: list[tuple[int, int, RuleProgress]] = []

    def group(self, task: OpenedTask, name: str, *known: str) -> CheckedGroup:
        self.progress = []
        question = CheckGroup(PLACE[name], self.degrees, known)
        answer = self.checks.answer(
            task, OPTIONS, question, lambda done, total, now: self.progress.append((done, total, now))
        )
        assert isinstance(answer, CheckedGroup)
        return answer

    @property
    def results(self) -> list[RuleResult]:
        return [now.result for _, _, now in self.progress if now.result is not None]


def test_each_rule_of_a_group_is_announced_checked_and_counted(versions: list[LoadedTask]) -> None:
    asked = Asked(
        WorkerChecks(lambda: False), "time-limit", "reward-modes", "unknown-name", "success-at-reset"
    )
    answer = asked.group(opened(versions[0], 3), "source", "reward-modes")
    assert answer == CheckedGroup(len(GROUPS) + 1, 4, GROUPS[1].name)
    assert [(done, total, now.rule, now.result is not None) for done, total, now in asked.progress] == [
        (0, 4, "time-limit", False),
        (1, 4, "time-limit", True),
        (1, 4, "unknown-name", False),
        (2, 4, "unknown-name", True),
    ]
    assert {result.state for result in asked.results} == {"kept"}
    assert asked.group(opened(versions[0], 3), GROUPS[-1].name).next == "GPU simulation"
    assert asked.progress == []


def test_each_version_is_checked_on_envs_of_its_own(versions: list[LoadedTask]) -> None:
    checks = Asked(WorkerChecks(lambda: False), "supported-robots", "info-rows", "rows-lost")
    states = []
    for version, num_envs in ((0, 3), (1, 1), (0, 1)):
        task = opened(versions[version], num_envs)
        checks.group(task, "source")
        states.append([result.state for result in checks.results])
        checks.group(task, "success")
        states[-1] += [result.state for result in checks.results]
    # With one env, what several envs would show is not known.
    assert states == [["kept", "kept"], ["broken", "not_known"], ["kept", "not_known"]]
    # The rules of GPU simulation come last: then the envs are closed, and the next check begins anew.
    answer = checks.group(opened(versions[0], 1), "GPU simulation")
    assert answer.next == "" and checks.progress[0][2] == RuleProgress("")
    assert [result.rule for result in checks.results] == ["rows-lost"]
    checks.group(opened(versions[0], 3), "success")
    assert [result.state for result in checks.results] == ["kept"]
    checks.checks.close()


def test_a_request_that_waits_ends_the_check_which_then_goes_on(versions: list[LoadedTask]) -> None:
    waits = True
    checks = Asked(WorkerChecks(lambda: waits), "info-rows")
    task = opened(versions[0], 1)
    with pytest.raises(CannotAnswer):
        checks.group(task, "success")
    assert checks.results == []
    waits = False
    checks.group(task, "success")
    assert [result.state for result in checks.results] == ["not_known"]
    checks.checks.close()
