"""Options of a check, and its division into items. An item is a rule on a part of the seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from workbench.actions.choose import SOLVE
from workbench.checks.results import RuleResult, Silenced
from workbench.checks.rule_table import degree_of_each, gpu_rules_of
from workbench.checks.run_rules import GPU_SIMULATION, GROUPS, RULES_OVER_SEEDS, RuleGroup
from workbench.envs.gpu_rules import Degree, Finding
from workbench.task.description import TaskOptions

SEEDS_OF_PART = 32
"""Number of seeds in a part. A part has `num_envs` seeds if that is more."""


@dataclass(frozen=True)
class CheckOptions:
    """Options of a check."""

    task: str
    options: TaskOptions = field(default_factory=lambda: TaskOptions(num_envs=8))
    seeds: int = 32
    """Number of seeds that are checked, from ``options.seed`` on."""
    select: tuple[str, ...] = ()
    """Ids of the rules to check; empty for all."""
    ignore: tuple[str, ...] = ()
    actions: str = "random"
    """Source of the actions of further episodes, which run in addition to the random ones; see
    `RecordArguments.actions`."""
    workers: int | None = None
    """Number of processes, if no executor is given; None for as many as cores and chunks allow."""
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
    """Texts of the author's files by path."""


@dataclass(frozen=True)
class CheckUpdate:
    """Progress of a process; exactly one field is set."""

    task: CheckedTask | None = None
    """The imported task, sent when the checks begin."""
    activity: str = ""
    """Name of the work that is being done."""


@dataclass(frozen=True)
class ItemOutcome:
    """Result of an item: of a rule for one part of the seeds, or of all rules of GPU simulation."""

    results: tuple[RuleResult, ...]
    findings: tuple[Finding, ...] = ()
    """Findings of the rules of GPU simulation."""
    silenced: tuple[Silenced, ...] = ()
    """Findings of the rules of GPU simulation that a comment silences."""
    picture_seconds: float = 0.0
    """Seconds that the first pictures of a process took."""
    task: CheckedTask | None = None
    """The checked task; set in the first item of each chunk."""


def groups_of(degrees: Mapping[str, Degree]) -> list[RuleGroup]:
    """The groups without the rules that are off; empty groups are left out, `GPU_SIMULATION` comes last."""
    groups = [
        RuleGroup(group.name, {rule: check for rule, check in group.checks.items() if degrees[rule] != "off"})
        for group in GROUPS
    ]
    # The last group also shows whether the task runs.
    core = [GPU_SIMULATION] if gpu_rules_of(degrees) or degrees["runs"] != "off" else []
    return [*(group for group in groups if group.checks), *core]


def count_rules(degrees: Mapping[str, Degree]) -> int:
    """Number of rules that a check gives a result for."""
    return sum(degree != "off" for degree in degrees.values())


def degrees_of_request(what: CheckOptions) -> dict[str, Degree]:
    """The degree of each rule. Raises ValueError for a request that is invalid."""
    for name, number in (("seeds", what.seeds), ("workers", what.workers)):
        if number is not None and number < 1:
            raise ValueError(f"--{name} must be at least 1, not {number}")
    if what.actions == SOLVE:
        raise ValueError(
            "--actions solve is for workbench record; to check rules on planned episodes, use --solve"
        )
    degrees = degree_of_each(what.select, what.ignore, solve=what.solve)
    if not groups_of(degrees):
        raise ValueError("no rule is left to check")
    return degrees


@dataclass(frozen=True)
class Item:
    """Rules and seeds that are checked together."""

    part: int
    group: RuleGroup
    rules: tuple[str, ...]
    """A single rule of the group, or all rules of GPU simulation for `GPU_SIMULATION`."""


@dataclass(frozen=True)
class CheckPlan:
    """The items of a check, by number. With one part of the seeds, a chunk is the rules of one group, which
    use the same evidence. With several parts, a chunk is all rules of one part, which use the same episodes.
    Rules that do not depend on the seeds are checked in the first part only."""

    items: Mapping[int, Item]
    chunk: int
    """Number of item numbers in a chunk; some numbers have no item."""
    part: int
    """Number of seeds of a part: at least one for each env, since some rules compare whole batches."""
    parts: int

    @property
    def chunks(self) -> int:
        return len({number // self.chunk for number in self.items})

    def episodes(self, part: int, seeds: int) -> range:
        """Indices of the seeds of a part, from 0. `seeds` is the number of all seeds."""
        return range(part * self.part, min((part + 1) * self.part, seeds))


def plan_of(what: CheckOptions, degrees: Mapping[str, Degree]) -> CheckPlan:
    part = max(SEEDS_OF_PART, what.options.num_envs)
    parts = -(-what.seeds // part)
    groups = groups_of(degrees)
    width = max(len(group.checks) for group in GROUPS)
    items: dict[int, Item] = {}
    for k in range(parts):
        for g, group in enumerate(groups):
            first = (k * len(groups) + g) * width
            if group is GPU_SIMULATION and k == 0:
                items[first] = Item(k, group, tuple(gpu_rules_of(degrees)))
            for r, rule in enumerate(group.checks):
                if k == 0 or rule in RULES_OVER_SEEDS:
                    items[first + r] = Item(k, group, (rule,))
    return CheckPlan(items, width if parts == 1 else width * len(groups), part, parts)


def count_chunks(what: CheckOptions) -> int:
    """Number of chunks of the job. Raises ValueError for a request that is invalid."""
    return plan_of(what, degrees_of_request(what)).chunks


def count_items(what: CheckOptions, chunks: range) -> int:
    """Number of items in these chunks."""
    plan = plan_of(what, degrees_of_request(what))
    return sum(number // plan.chunk in chunks for number in plan.items)
