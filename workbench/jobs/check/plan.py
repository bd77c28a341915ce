"""What a check is, and how it is cut into items: groups of rules on parts of the seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from workbench.checks.by_hook.run import CORE_GROUP, GROUPS, RULES_OVER_SEEDS, RuleGroup
from workbench.checks.results import RuleResult, Silenced
from workbench.checks.rules import CHECK_RULES, RULES, degree_of_each
from workbench.core.rules import Degree, Finding
from workbench.jobs.actions import SOLVE
from workbench.jobs.task import TaskOptions

SEEDS_OF_PART = 32
"""Seeds that are looked at together, in one set of envs."""


@dataclass(frozen=True)
class CheckOptions:
    """What to check, and how."""

    task: str
    options: TaskOptions = field(default_factory=lambda: TaskOptions(num_envs=8))
    seeds: int = 32
    """How many are tried, from ``options.seed`` on."""
    select: tuple[str, ...] = ()
    """Only these rules; empty for all."""
    ignore: tuple[str, ...] = ()
    actions: str = "random"
    """As `RecordArguments.actions`. In further episodes, beside random ones, what it names acts."""
    workers: int | None = None
    """Processes, if no executor is given; None for as many as cores and chunks allow."""
    solve: bool = False
    """Whether the rules that need planned episodes are checked too."""


@dataclass(frozen=True)
class CheckedTask:
    """The task that was imported."""

    env_id: str
    class_name: str
    file: str | None
    others: tuple[str, ...] = ()
    """Further tasks of the file, which were not checked."""
    notices: tuple[str, ...] = ()
    source: Mapping[str, str] = field(default_factory=dict)
    """Path to text of the author's files."""


@dataclass(frozen=True)
class CheckUpdate:
    """Progress of a process; one of these."""

    task: CheckedTask | None = None
    """It is imported, and the checks begin."""
    activity: str = ""
    """What is being looked at."""
    result: RuleResult | None = None
    """To be shown as it comes: it comes again with its group."""


@dataclass(frozen=True)
class GroupOutcome:
    """What a group of rules came to for one part of the seeds."""

    results: tuple[RuleResult, ...]
    findings: tuple[Finding, ...] = ()
    """Of rules of GPU simulation."""
    silenced: tuple[Silenced, ...] = ()
    """Likewise, with a comment that silences it."""
    picture_seconds: float = 0.0
    """For the first pictures of a process."""
    task: CheckedTask | None = None
    """With the first group of each chunk."""


def groups_of(degrees: Mapping[str, Degree]) -> list[RuleGroup]:
    """The groups with a rule that is not off; the last one lets the rules of GPU simulation look, and checks none itself."""
    groups = [group for group in GROUPS if any(degrees[rule] != "off" for rule in group.checks)]
    core = any(degrees[rule] != "off" for rule in RULES if rule not in CHECK_RULES)
    # Whether the task runs is known from there too.
    return [*groups, RuleGroup(CORE_GROUP, {})] if core or degrees["runs"] != "off" else groups


def count_rules(degrees: Mapping[str, Degree]) -> int:
    """How many rules a check gives a result of."""
    in_groups = {rule for group in groups_of(degrees) for rule in group.checks if degrees[rule] != "off"}
    core = {rule for rule in RULES if rule not in CHECK_RULES and degrees[rule] != "off"}
    return len(in_groups | core)


def degrees_of_request(what: CheckOptions) -> dict[str, Degree]:
    """The degree of each rule. Raises ValueError for a request that is invalid."""
    for name, number in (("seeds", what.seeds), ("workers", what.workers)):
        if number is not None and number < 1:
            raise ValueError(f"--{name} must be at least 1, not {number}")
    if what.actions == SOLVE:
        raise ValueError("--actions solve is for workbench record: --solve checks rules on planned episodes")
    degrees = degree_of_each(what.select, what.ignore, solve=what.solve)
    if not groups_of(degrees):
        raise ValueError("no rule is left to check")
    return degrees


@dataclass(frozen=True)
class CheckPlan:
    """The items of a check: groups of rules on parts of the seeds. Those that do not depend on the seeds are looked at in the
    first part alone."""

    groups: list[RuleGroup]
    over_seeds: frozenset[str]
    """Rules that are checked in every part."""
    part: int
    """Seeds of a part. What compares whole batches takes one for each env."""
    parts: int

    @property
    def numbers(self) -> list[int]:
        """Group g of part k is item ``k * len(groups) + g``."""
        count = len(self.groups)
        further = [g for g, group in enumerate(self.groups) if not self.over_seeds.isdisjoint(group.checks)]
        return [*range(count), *(k * count + g for k in range(1, self.parts) for g in further)]

    @property
    def chunk(self) -> int:
        """Items of a chunk. Of one part each group is one; of several all groups of a part, which look at the same episodes."""
        return 1 if self.parts == 1 else len(self.groups)

    @property
    def chunks(self) -> int:
        return len(self.groups) if self.parts == 1 else self.parts

    def of(self, number: int) -> tuple[int, RuleGroup]:
        """Part and group of an item."""
        part, group = divmod(number, len(self.groups))
        return part, self.groups[group]

    def episodes(self, part: int, seeds: int) -> range:
        """Which of so many seeds are in a part, from 0 on."""
        return range(part * self.part, min((part + 1) * self.part, seeds))


def plan_of(what: CheckOptions, degrees: Mapping[str, Degree]) -> CheckPlan:
    part = max(SEEDS_OF_PART, what.options.num_envs)
    over_seeds = frozenset(rule for rule in RULES_OVER_SEEDS if degrees[rule] != "off")
    return CheckPlan(groups_of(degrees), over_seeds, part, -(-what.seeds // part))


def count_chunks(what: CheckOptions) -> int:
    """Chunks of the job. Raises ValueError for a request that is invalid."""
    return plan_of(what, degrees_of_request(what)).chunks


def count_groups(what: CheckOptions, chunks: range) -> int:
    """Groups of rules in these chunks, counted for each part of the seeds."""
    plan = plan_of(what, degrees_of_request(what))
    return sum(number // plan.chunk in chunks for number in plan.numbers)
