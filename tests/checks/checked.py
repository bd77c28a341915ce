"""Runs the check of one rule on an edited copy of the example task, or on another text."""

from __future__ import annotations

import linecache
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from mani_skill.utils.registration import REGISTERED_ENVS

from workbench.checks import run_rules as run
from workbench.checks.evidence.collect import Checkup
from workbench.checks.evidence.rolled_episodes import Actor
from workbench.checks.results import RuleResult, by_rule
from workbench.checks.rule_table import RULES, gpu_rules_of
from workbench.envs.gpu_rules import Finding
from workbench.task.load import load_task, undo_load

EXAMPLE = Path(__file__).parents[2] / "tasks" / "push_cube.py"
Edits = tuple[tuple[str, str], ...]
Checked = Callable[..., RuleResult]
CheckedRules = Callable[..., dict[str, RuleResult]]


@pytest.fixture
def checked(checked_rules: CheckedRules) -> Checked:
    """The same as `checked_rules` for one rule; returns its result."""
    return lambda rule, *edits, **more: checked_rules([rule], *edits, **more)[rule]


@pytest.fixture
def checked_rules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CheckedRules:
    """A function ``checked_rules(rules, (old, new), ..., text=..., num_envs=4, seeds=8, **env_kwargs)`` that returns the
    result of each rule.

    Each `old` must be in the text, which is the example's by default.
    """

    # Other tests in this process leave the example's id registered by another file.
    for known in (REGISTERED_ENVS, gymnasium.registry):
        for env_id in ("WorkbenchPushCube-v1", "WorkbenchPushCube"):
            monkeypatch.delitem(known, env_id, raising=False)

    def check(
        rules: Collection[str],
        *edits: tuple[str, str],
        text: str | None = None,
        num_envs: int = 4,
        seeds: int = 8,
        **env_kwargs: Any,
    ) -> dict[str, RuleResult]:
        file = tmp_path / "task.py"
        content = EXAMPLE.read_text() if text is None else text
        for old, new in edits:
            assert old in content, old
            content = content.replace(old, new)
        file.write_text(content)
        linecache.checkcache(str(file))
        return check_rules(rules, str(file), num_envs=num_envs, seeds=seeds, **env_kwargs)

    return check


def check_rule(rule: str, reference: str, num_envs: int, seeds: int, **env_kwargs: Any) -> RuleResult:
    """The result of one rule on a task file or an id."""
    return check_rules([rule], reference, num_envs, seeds, **env_kwargs)[rule]


def check_rules(
    rules: Collection[str],
    reference: str,
    num_envs: int,
    seeds: int,
    actors: Sequence[Actor] = (),
    **env_kwargs: Any,
) -> dict[str, RuleResult]:
    """The results of these rules on a task file or an id."""
    degrees = dict.fromkeys(RULES, "off") | {rule: RULES[rule].degree for rule in rules}
    loaded = load_task(reference)
    checkup = Checkup(loaded, env_kwargs, num_envs=num_envs, seeds=seeds, actors=actors)
    try:
        return by_rule(results_of(checkup, degrees))
    finally:
        checkup.close()
        undo_load(loaded)


def results_of(checkup: Checkup, degrees: Mapping[str, Any]) -> list[RuleResult]:
    """Results of all rules that are not off; rules of GPU simulation come last."""
    results: list[RuleResult] = []
    for group in run.GROUPS:
        for rule, check in group.checks.items():
            if degrees.get(rule, "off") != "off":
                results += run.check_rule(rule, check, checkup, degrees)
    if gpu_rules_of(degrees):
        results += run.check_gpu_rules(checkup, degrees)
    return [*results, *run.gpu_results(run.findings_of(checkup), checkup.silenced, degrees)]


def the_finding(result: RuleResult) -> Finding:
    """The only finding of a broken rule."""
    assert result.state == "broken", result
    (finding,) = result.findings
    return finding
