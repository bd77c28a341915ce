"""Declares the check of a rule: id, degree and hook in the decorator, the page in the docstring."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from workbench.checks.evidence.collect import Check, Checkup, Found, Note
from workbench.checks.evidence.over_seeds import OverSeeds
from workbench.checks.results import Seen
from workbench.envs.gpu_rules import DeclaredRule, Degree, declared_rule
from workbench.envs.outliers import OUTLIER_RULES

See = Callable[[Checkup], Iterator[Seen]]


@dataclass(frozen=True)
class RuleCheck:
    """A rule, and the check that decides whether a task keeps it."""

    rule: DeclaredRule
    check: Check


Declare = Callable[[Callable[[Any], Iterator[Found | Note]]], RuleCheck]
"""A decorator for a `Check`, or for the `judge` function of an `OverSeeds` check."""


def rule(id: str, degree: Degree, hook: str, *, see: See | None = None, solve: bool = False) -> Declare:
    """Declare the decorated function as the check of a rule, and its docstring as the rule's page (`declared_rule`).

    Args:
        see: only for a rule over all seeds: gives rows about a part of the seeds. The decorated function
            judges the rows.
        solve: as `Rule.solve`.
    """

    def declare(function: Callable[[Any], Iterator[Found | Note]]) -> RuleCheck:
        declared = declared_rule(id, degree, hook, function.__doc__ or "", solve=solve)
        return RuleCheck(declared, _check_of(function, see))

    return declare


def outlier_check(id: str, *, see: See) -> Declare:
    """Declare the decorated function as the check of a rule of `OUTLIER_RULES`, which also has the rule's
    page.

    Args:
        see: as in `rule`.
    """
    return lambda function: RuleCheck(OUTLIER_RULES[id], _check_of(function, see))


def _check_of(function: Callable[[Any], Iterator[Found | Note]], see: See | None) -> Check:
    return function if see is None else OverSeeds(see, function)


def checks_in(*modules: ModuleType) -> tuple[RuleCheck, ...]:
    """The checks that these modules declare, in the order of their text."""
    return tuple(
        member for module in modules for member in vars(module).values() if isinstance(member, RuleCheck)
    )
