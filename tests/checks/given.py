"""The example task with evidence that a test gives, such as episodes that all differ: rules are tried without stepping envs."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from tests.checks.checked import EXAMPLE
from workbench.checks import run_rules as run
from workbench.checks.evidence.collect import Checkup
from workbench.checks.evidence.odd_states import OddStates, odd_states
from workbench.checks.evidence.rolled_episodes import Episodes
from workbench.checks.results import RuleResult
from workbench.checks.rule_table import degree_of_each
from workbench.task.load import load_task, undo_load

SEEDS = [20, 21, 22]
Judged = Callable[..., RuleResult]
CHECKS = {rule: check for group in run.GROUPS for rule, check in group.checks.items()}


@pytest.fixture(scope="module")
def example() -> Iterator[Checkup]:
    """Three envs of the example task, and seeds that are not the envs' indices."""
    loaded = load_task(str(EXAMPLE))
    made = Checkup(loaded, {"render_backend": "none"}, num_envs=3, seeds=3, first_seed=SEEDS[0])
    yield made
    made.close()
    undo_load(loaded)


@pytest.fixture
def judged(example: Checkup) -> Judged:
    """`outcome` on the example's envs."""
    return functools.partial(outcome, example)


def outcome(
    example: Checkup, rule: str, odd: OddStates | None = None, mode: str = "", **evidence: Any
) -> RuleResult:
    """The result of a rule on the example's envs, with this evidence in place of what the envs would do.

    Args:
        odd: results in the odd states; none by default.
        mode: reward mode; that of the envs by default.
    """
    given = copy.copy(example)
    looks = {odd_states: odd or OddStates()}
    if mode:
        vars(given)["task"] = SimpleNamespace(env=SimpleNamespace(reward_mode=mode))
    vars(given).update(failed={}, look=lambda see: looks[see] if see in looks else see(given))
    vars(given).update(evidence)
    return run.check_rule(rule, CHECKS[rule], given, degree_of_each())[0]


def flags(words: str) -> NDArray[np.bool_]:
    """(T, K) from a word for each of the K episodes: ``"001 010"``."""
    return np.array([[digit == "1" for digit in word] for word in words.split()]).T


def episodes(
    reward: ArrayLike = (),
    obs: dict[str, NDArray[np.float64]] | None = None,
    kind: str = "random",
    seeds: Sequence[int] = SEEDS,
    **evaluate: str | NDArray[Any],
) -> Episodes:
    """Episodes from these seeds.

    Args:
        reward: (T, K)
        evaluate: words as in `flags`, or (T + 1, K, ...) numbers.
    """
    entries = {name: flags(of) if isinstance(of, str) else np.array(of) for name, of in evaluate.items()}
    return Episodes(
        kind, list(seeds), evaluate=entries, reward=np.array(reward, np.float32), obs=dict(obs or {})
    )
