"""Content of the Checks tab: findings of the checks and of playing, one card for each rule."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from workbench.checks.results import RuleResult, State, counts, state_text
from workbench.checks.rule_pages import RulePage, rule_page
from workbench.checks.rule_table import RULES
from workbench.checks.state import ChecksView
from workbench.envs.gpu_rules import DEGREES, Degree, Finding, Rule
from workbench.envs.outliers import OUTLIER_RULES

_SUMMED: tuple[State, ...] = ("kept", "silenced", "not_known", "not_applicable", "failed")
_UNDECIDED: tuple[State, ...] = ("not_known", "not_applicable")
MAX_SHOWN = 5
"""Maximum number of findings of one rule that are shown."""


@dataclass(frozen=True)
class Row:
    """A finding."""

    finding: Finding
    played: str = ""
    """Text: how often the finding was seen while playing; empty if only the checks found it."""
    old: bool = False
    """Whether the finding is from an earlier version and its rule has not been checked again."""


@dataclass(frozen=True)
class Card:
    """The findings of one rule."""

    rule: Rule
    degree: Degree
    """The worst degree of the findings."""
    rows: tuple[Row, ...]

    @property
    def old(self) -> bool:
        return all(row.old for row in self.rows)

    @property
    def page(self) -> RulePage | None:
        return rule_page(self.rule.id)

    @property
    def silence(self) -> str:
        """The comment that silences the rule, up to the reason, which the author has to add."""
        return f"# workbench: off[{self.rule.id}] "


def cards(checks: ChecksView, played: Iterable[Finding] = ()) -> list[Card]:
    """Cards by degree: ``stop``, then ``warn``. Cards that hold only findings of an earlier version come
    last.

    Args:
        played: findings seen while playing.
    """
    rows = [Row(finding) for finding in checks.findings]
    for finding in played:
        place = _same(finding, rows)
        if place is None:
            rows.append(Row(finding, _played(finding)))
            continue
        known = rows[place].finding
        same = known.key == finding.key
        rows[place] = Row(known, _played(finding) if same else f"{_played(finding)}: {finding.message}")
    # Leave out a finding of an earlier version that has a row already. Playing shows a breach of a rule of
    # GPU simulation at once, but the checks reach these rules last.
    rows += [Row(finding, old=True) for finding in checks.before if _same(finding, rows) is None]
    together: dict[str, list[Row]] = {}
    for row in rows:
        if row.finding.rule in RULES:
            together.setdefault(row.finding.rule, []).append(row)
    found = [Card(RULES[rule], _worst(row.finding for row in of), tuple(of)) for rule, of in together.items()]
    return sorted(found, key=lambda card: (card.old, DEGREES.index(card.degree)))


def _same(finding: Finding, rows: Sequence[Row]) -> int | None:
    """Index of the row with the same finding; None if there is none. An outlier also matches another row of
    its rule: playing reports an outlier at a hook, the checks report it at a line."""
    of_rule = [place for place, row in enumerate(rows) if row.finding.rule == finding.rule]
    alike = [place for place in of_rule if rows[place].finding.key == finding.key]
    if not alike and finding.rule in OUTLIER_RULES:
        alike = of_rule
    return next(iter(alike), None)


def count(shown: Iterable[Card]) -> int:
    """Number of findings; findings of an earlier version count until their rule is checked again."""
    return sum(len(card.rows) for card in shown)


def without_finding(checks: ChecksView, shown: list[Card]) -> list[RuleResult]:
    """Results of the rules without a finding. A rule is left out if playing found a breach of it, even if the
    checks found none."""
    broken = {card.rule.id for card in shown if not card.old}
    return [result for result in checks.results if result.rule not in broken]


@dataclass(frozen=True)
class Undecided:
    """Rules with the same state for the same reason."""

    state: str
    """State, as `state_text` gives it."""
    why: str
    rules: tuple[str, ...]


def undecided(results: Iterable[RuleResult]) -> list[Undecided]:
    """Rules that are not known, then rules that are not applicable, grouped by reason."""
    found: dict[tuple[State, str], list[str]] = {}
    for state in _UNDECIDED:
        for result in results:
            if result.state == state:
                found.setdefault((state, result.why), []).append(result.rule)
    return [Undecided(state_text(state), why, tuple(rules)) for (state, why), rules in found.items()]


def summary(checks: ChecksView, shown: list[Card]) -> str:
    """Number of findings by degree, then number of rules by state: ``2 stop, 3 warn, 50 kept, 3 not
    known``."""
    by_degree = dict.fromkeys(DEGREES, 0)
    for card in shown:
        for row in card.rows:
            by_degree[row.finding.degree] += not row.old
    states = counts(without_finding(checks, shown))
    old = sum(row.old for card in shown for row in card.rows)
    counted = (
        *((by_degree[degree], degree) for degree in DEGREES),
        *((states[state], state_text(state)) for state in _SUMMED),
        (old, "of the previous version"),
    )
    return ", ".join(f"{number} {what}" for number, what in counted if number)


def times(count: int) -> str:
    """``once``, ``7 times``, ``300 times and more``. Of large counts only the first digit is shown, so that
    the list does not change at each step."""
    if count < 10:
        return "once" if count == 1 else f"{count} times"
    scale = 10 ** (len(str(count)) - 1)
    return f"{count // scale * scale:,} times and more".replace(",", " ")


def _played(finding: Finding) -> str:
    since = f"first at step {finding.first_step}" if finding.first_step else "from the start"
    return f"while playing {times(finding.count)}, {since}"


def _worst(findings: Iterable[Finding]) -> Degree:
    degrees: list[Degree] = [finding.degree for finding in findings]
    return min(degrees, key=DEGREES.index)
