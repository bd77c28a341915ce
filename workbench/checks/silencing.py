"""Finds silencing comments without effect. Imports no simulator."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from workbench.checks.results import RuleResult, State
from workbench.checks.rule_table import RULES, did_you_mean
from workbench.envs.gpu_rules import Silence, silences
from workbench.machine.parse_python import parse_python

_DECIDED: tuple[State, ...] = ("kept", "broken", "silenced")


@dataclass(frozen=True)
class Comment:
    """A silencing comment in the source without effect."""

    file: str
    line: int
    message: str


def comments_without_effect(
    sources: Mapping[str, str],
    results: Iterable[RuleResult] = (),
    class_name: str = "",
    others: Collection[str] = (),
) -> list[Comment]:
    """The silencing comments that lack a reason, name an unknown rule, or silence no finding.

    Args:
        sources: texts of the author's files by path.
        results: results of all checked rules, once the check is done. Only a rule that is kept, broken or
            silenced can show that a comment silences no finding.
        class_name: the class that was checked. In other tasks, comments that silence no finding are not
            reported, since these tasks were not checked.
        others: class names of other tasks in the file.
    """
    found: list[Comment] = []
    by_rule = {result.rule: result for result in results if result.state in _DECIDED}
    for file, text in sources.items():
        comments = silences(text)
        unchecked = (
            frozenset[int]() if not comments else _lines_of_other_tasks(sources, file, class_name, others)
        )
        for comment in comments:
            found += [Comment(file, comment.line, message) for message in _mistakes(comment)]
            idle = [
                rule
                for rule in sorted(comment.rules & by_rule.keys())
                if comment.reason
                and comment.line not in unchecked
                and not _silences(by_rule[rule], file, comment.line)
            ]
            if idle:
                message = f"off[{', '.join(idle)}] silenced nothing in this check: remove it if it is not needed any more"
                found.append(Comment(file, comment.line, message))
    return found


def _mistakes(comment: Silence) -> Iterator[str]:
    for rule in sorted(comment.rules - RULES.keys()):
        yield f"no rule is called {rule}{did_you_mean(rule)}"
    if not comment.rules:
        yield "the comment names no rule: write an id in the brackets, such as off[reward-rows]"
    elif not comment.reason:
        named = ", ".join(sorted(comment.rules))
        yield f"off[{named}] silences nothing until a reason follows it"


def _silences(result: RuleResult, file: str, line: int) -> bool:
    return any(one.finding.file == file and one.line == line for one in result.silenced)


def _lines_of_other_tasks(
    sources: Mapping[str, str], file: str, class_name: str, others: Collection[str]
) -> frozenset[int]:
    """Lines of a file that belong to the classes of other tasks."""
    classes = {path: _classes(text) for path, text in sources.items()}
    family, waiting = {class_name}, [class_name]
    while waiting:
        name = waiting.pop()
        for node in (node for nodes in classes.values() for node in nodes if node.name == name):
            bases = _bases(node) - family
            family |= bases
            waiting += bases
    return frozenset(
        line
        for node in classes[file]
        if node.name in others or (node.name not in family and not family.isdisjoint(_bases(node)))
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    )


def _classes(text: str) -> list[ast.ClassDef]:
    try:
        return [node for node in ast.walk(parse_python(text)) if isinstance(node, ast.ClassDef)]
    except (SyntaxError, ValueError, RecursionError):
        return []  # a file that is being edited may not parse


def _bases(node: ast.ClassDef) -> set[str]:
    return {str(getattr(base, "attr", getattr(base, "id", ""))) for base in node.bases} - {""}
