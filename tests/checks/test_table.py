"""The table of rules: each rule has one check, and each outlier belongs to a rule."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.checks.checked import EXAMPLE
from workbench.checks.rule_table import RULES
from workbench.checks.run_rules import GROUPS
from workbench.envs.gpu_rules import GPU_RULES
from workbench.envs.outliers import OUTLIER_RULES, OutlierKind
from workbench.task.load import LoadedTask, load_task, undo_load
from workbench.task.outlier_rules import rules_of_outliers

SILENCED = (
    "    def evaluate(self) -> dict[str, torch.Tensor]:",
    "    def evaluate(self) -> dict[str, torch.Tensor]:  # workbench: off[entries-finite] NaN is unknown",
)


@pytest.fixture
def silenced(tmp_path: Path) -> Iterator[LoadedTask]:
    file = tmp_path / "task.py"
    assert SILENCED[0] in EXAMPLE.read_text()
    file.write_text(EXAMPLE.read_text().replace(*SILENCED))
    loaded = load_task(str(file))
    yield loaded
    undo_load(loaded)


def test_an_outlier_is_reported_at_its_rules_hook_unless_silenced_or_off(silenced: LoadedTask) -> None:
    rules = rules_of_outliers(silenced, None)
    assert {rule: finding.function for rule, finding in rules.items()} == {
        "bodies-stay": "_initialize_episode",
        "observation-finite": "_get_obs_extra",
        "reward-finite": "compute_dense_reward",
        "reward-normalized": "compute_normalized_dense_reward",
    }
    assert rules["reward-finite"].code.startswith("def compute_dense_reward(")
    assert (rules["reward-finite"].degree, rules["bodies-stay"].degree) == ("stop", "warn")
    assert {finding.degree for finding in rules_of_outliers(silenced, "warn").values()} == {"warn"}
    assert rules_of_outliers(silenced, "off") == {}


def test_rules_in_the_table_and_checks_match_one_to_one() -> None:
    checked = Counter(rule for group in GROUPS for rule in group.checks)
    assert set(checked) == RULES.keys() - GPU_RULES.keys() and max(checked.values()) == 1


def test_each_outlier_except_actions_belongs_to_a_checked_rule() -> None:
    without = {kind for kind in OutlierKind if kind.rule is None}
    assert (
        without == {OutlierKind.ACTION_NOT_FINITE} and RULES.keys() - GPU_RULES.keys() >= OUTLIER_RULES.keys()
    )
