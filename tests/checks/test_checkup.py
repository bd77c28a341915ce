"""What checks share: envs with a renderer where there must be one, and what is told of a task that raises."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.checks.checked import EXAMPLE, Checked, check_rules, results_of, the_finding
from workbench.authoring.loading.load import load_task, undo_load
from workbench.checks.evidence.checkup import Checkup
from workbench.checks.rules import RULES


def test_a_task_that_cannot_be_built_without_a_renderer_gets_one(renderer: None) -> None:
    loaded = load_task("PushT-v1")
    checkup = Checkup(loaded, num_envs=2, seeds=2)
    try:
        with checkup.env(1) as task:
            assert checkup.reset(task, 0).poses.shape[0] == 1
        names = [each.name for each in checkup.builds if each.place is not None]
        assert names and len(names) == len(set(names)), "the build that raised is forgotten"
    finally:
        checkup.close()
        undo_load(loaded)


def test_a_task_that_raises_with_a_renderer_too_is_told_once(renderer: None, tmp_path: Path) -> None:
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


def test_what_fails_for_want_of_a_renderer_is_no_cause_of_what_fails_with_one(
    renderer: None, tmp_path: Path
) -> None:
    file, built = tmp_path / "task.py", 'self.cube = builder.build(name="cube")\n'
    looks = "self.cube._objs[0].find_component_by_type(sapien.render.RenderBodyComponent).compute_global_aabb_tight()"
    text = EXAMPLE.read_text()
    assert built in text
    file.write_text(text.replace(built, f"{built}        {looks}\n        raise ValueError('mine')\n"))
    loaded = load_task(str(file))
    checkup = Checkup(loaded, num_envs=2, seeds=2)
    try:
        (result,) = [
            one
            for one in results_of(checkup, dict.fromkeys(RULES, "off") | {"runs": "warn"})
            if one.rule == "runs"
        ]
    finally:
        checkup.close()
        undo_load(loaded)
    assert (
        "ValueError: mine" in the_finding(result).message
        and "AttributeError" not in the_finding(result).message
    )


def test_a_loop_in_the_source_is_told_where_the_task_cannot_be_built(checked: Checked) -> None:
    at = "        height = self.cube.pose.p[:, 2] - CUBE_HALF_SIZE\n"
    loop = "        for i in range(self.num_envs): pass\n"
    edits = (at, at + loop), ('name="goal"', "name=self.gone")
    result = checked("loop-over-envs", *edits, render_backend="none")
    assert result.state == "broken" and "gone" in result.why
    assert [finding.code for finding in result.findings] == [loop.strip()]


ONE_ENV = "        super().__init__(*args, robot_uids=robot_uids, **kwargs)\n"
ONLY = "        if kwargs.get('num_envs', 1) != 1: raise ValueError('one env only')\n"


def test_of_one_env_no_rule_makes_more_and_what_needs_more_is_not_known(
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
def test_a_task_that_is_written_for_one_env_is_told_so_at_its_line(
    checked: Checked, rule: str, before: str, line: str
) -> None:
    edit = before, f"        {line}\n{before}"
    finding = the_finding(checked(rule, edit))
    assert "--num-envs 1" in finding.message and finding.line is not None
    if rule == "runs":
        assert finding.code == line
    assert checked(rule, edit, num_envs=1).findings == ()


def test_what_a_robot_of_the_author_raises_is_theirs(checked: Checked) -> None:
    """The reach is measured by its property, which no hook of the task calls here."""
    robot = (
        "@register_agent()\nclass Odd(Panda):\n    uid = 'odd_arm'\n\n    @property\n    def tcp(self):\n"
        "        raise ValueError('no tcp yet')\n\n    @tcp.setter\n    def tcp(self, value):\n        self.kept = value\n\n\n"
    )
    imports = "from mani_skill.agents.registration import register_agent\nfrom mani_skill.agents.robots import Panda\n"
    above = '@register_env("WorkbenchPushCube-v1"'
    edits = (
        ("import numpy as np\n", f"import numpy as np\n{imports}"),
        (above, robot + above),
        ("self.agent.tcp.pose", "self.agent.kept.pose"),
    )
    result = checked("outside-reach", *edits, robot_uids="odd_arm")
    assert result.state == "not_known" and result.problem is not None
    assert result.problem.code == "raise ValueError('no tcp yet')"


def test_what_one_env_raises_too_gets_no_advice_to_take_one(checked: Checked) -> None:
    edit = '"cube_height": height,', '"cube_height": height / self.gone,'
    assert "--num-envs" not in the_finding(checked("runs", edit)).message
