"""The part that checks share: envs with a renderer where one is needed, and reports on a task that raises."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.checks.checked import EXAMPLE, Checked, check_rules, results_of, the_finding
from workbench.checks.evidence.collect import Checkup
from workbench.checks.rule_table import RULES
from workbench.task.load import load_task, undo_load


def test_a_task_that_cannot_be_built_without_a_renderer_gets_one(renderer: None) -> None:
    loaded = load_task("PushT-v1")
    checkup = Checkup(loaded, num_envs=2, seeds=2)
    try:
        with checkup.env(1) as task:
            assert checkup.reset(task, 0).poses.shape[0] == 1
        names = [each.name for each in checkup.builds if each.place is not None]
        assert names and len(names) == len(set(names)), "the failed build must not be counted"
    finally:
        checkup.close()
        undo_load(loaded)


def test_a_task_that_raises_with_and_without_a_renderer_is_reported_once(
    renderer: None, tmp_path: Path
) -> None:
    file = tmp_path / "task.py"
    file.write_text(EXAMPLE.read_text().replace('name="goal"', "name=self.gone"))
    loaded = load_task(str(file))
    checkup = Checkup(loaded, num_envs=2, seeds=2)
    try:
        rules = "runs", "loop-over-envs", "device-copies", "foreign-device"
        results = results_of(checkup, dict.fromkeys(RULES, "off") | dict.fromkeys(rules, "warn"))
    finally:
        checkup.close()
        undo_load(loaded)
    runs = [result for result in results if result.rule == "runs"]
    assert {finding.key for result in runs for finding in result.findings} == {runs[0].findings[0].key}
    assert "self.gone" in runs[0].findings[0].code
    assert {result.state for result in results if result.rule != "runs"} == {"not_known"}


ONE_ENV = "        super().__init__(*args, robot_uids=robot_uids, **kwargs)\n"
ONLY = "        if kwargs.get('num_envs', 1) != 1: raise ValueError('one env only')\n"


@pytest.mark.slow
def test_with_one_env_no_rule_makes_more_envs_and_rules_that_need_more_are_not_known(
    tmp_path: Path, renderer: None
) -> None:
    text = EXAMPLE.read_text()
    assert ONE_ENV in text
    (tmp_path / "task.py").write_text(text.replace(ONE_ENV, ONLY + ONE_ENV))
    rules = RULES.keys() - {"runs", "id-taken"}  # other tests of the process register the example too
    results = check_rules(rules, str(tmp_path / "task.py"), num_envs=1, seeds=3)
    assert [result for result in results.values() if result.problem is not None or result.findings] == []
    assert rules == results.keys()
    needs_more = {rule for rule, result in results.items() if "several envs" in result.why}
    assert {
        "other-env-written",
        "evaluate-rows",
        "batch-of-reset",
        "loop-over-envs",
        "reward-flat",
    } <= needs_more
    assert not needs_more & {"success-at-reset", "reward-finite", "state-restores", "device-copies"}
    assert {results[rule].state for rule in needs_more} == {"not_known"}


WRITTEN_FOR_ONE = (
    pytest.param("runs", '        reward[info["fail"]] = 0\n', "if info['fail']: reward = 0 * reward", id="an if"),
    pytest.param("evaluate-rows", "        return {\n", "distance, height = distance[:1], height[:1]", id="one row"),
)  # fmt: skip


@pytest.mark.parametrize(("rule", "before", "line"), WRITTEN_FOR_ONE)
def test_a_task_written_for_one_env_is_reported_at_its_line(
    checked: Checked, rule: str, before: str, line: str
) -> None:
    edit = before, f"        {line}\n{before}"
    finding = the_finding(checked(rule, edit))
    assert "--num-envs 1" in finding.message and finding.line is not None
    if rule == "runs":
        assert finding.code == line
    assert checked(rule, edit, num_envs=1).findings == ()
