"""All rules by id, and the degree of each in one check. Imports no simulator."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping
from pathlib import Path

import msgspec

from workbench.envs.gpu_rules import GPU_RULES, Degree, Rule

RULES_FILE = Path(__file__).with_name("rules.json")
"""All rules without their pages. ``python -m tests.docs.generate`` writes the file from the rules'
declarations."""


def _read() -> dict[str, Rule]:
    rules = msgspec.json.decode(RULES_FILE.read_bytes(), type=list[Rule])
    return {rule.id: rule for rule in rules}


RULES: Mapping[str, Rule] = _read()
"""All rules by id: first those of GPU simulation, then the others in the order in which they are checked."""
SOLVE_RULES = frozenset(rule.id for rule in RULES.values() if rule.solve)
"""Ids of the rules that need planned episodes."""


def did_you_mean(rule: str) -> str:
    """`` (did you mean reward-rows?)`` for an id that no rule has; empty if no id is similar."""
    close = difflib.get_close_matches(rule.lower().replace("_", "-"), RULES, n=1, cutoff=0.6)
    return f" (did you mean {close[0]}?)" if close else ""


def degree_of_each(
    select: Collection[str] = (),
    ignore: Collection[str] = (),
    choice: Degree | None = None,
    solve: bool = False,
) -> dict[str, Degree]:
    """The degree of each rule.

    Args:
        select: the rules to check; all others are off. Empty for all.
        ignore: rules that are off.
        choice: the degree of the rules that are not off; None for the default degree of each.
        solve: whether an empty `select` includes `SOLVE_RULES`.

    Raises:
        ValueError: an id that no rule has.
    """
    for rule in (*select, *ignore):
        if rule not in RULES:
            raise ValueError(
                f"no rule is called {rule!r}{did_you_mean(rule)}; `workbench help rules` lists them"
            )
    chosen = set(select or RULES) - set(ignore)
    if not solve and not select:
        chosen -= SOLVE_RULES
    return {rule.id: (choice or rule.degree) if rule.id in chosen else "off" for rule in RULES.values()}


def gpu_rules_of(degrees: Mapping[str, Degree]) -> list[str]:
    """The rules of GPU simulation that are not off."""
    return [rule for rule in GPU_RULES if degrees[rule] != "off"]
