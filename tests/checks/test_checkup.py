"""What checks share: envs with a renderer where there must be one, and what is told of a task that raises."""

from __future__ import annotations

from pathlib import Path

from tests.checks.checked import EXAMPLE, Checked, results_of
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


def test_a_loop_in_the_source_is_told_where_the_task_cannot_be_built(checked: Checked) -> None:
    at = "        height = self.cube.pose.p[:, 2] - CUBE_HALF_SIZE\n"
    loop = "        for i in range(self.num_envs): pass\n"
    edits = (at, at + loop), ('name="goal"', "name=self.gone")
    result = checked("loop-over-envs", *edits, render_backend="none")
    assert result.state == "broken" and "gone" in result.why
    assert [finding.code for finding in result.findings] == [loop.strip()]
