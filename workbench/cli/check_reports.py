"""Reports of a check as JSON, as JUnit's XML for CI, and as SARIF for code scanning."""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote
from xml.etree import ElementTree

from workbench.app.help_pages import find_topic
from workbench.checks.job import CheckReport
from workbench.checks.job_items import CheckOptions
from workbench.checks.results import RuleResult, State, state_text
from workbench.checks.rule_table import RULES
from workbench.envs.gpu_rules import FailOn, Finding, fails
from workbench.task.problem import Problem, place_text

DISTRIBUTION = "maniskill-workbench"
SCHEMA = "https://json.schemastore.org/sarif-2.1.0.json"
LEVELS = {"stop": "error", "warn": "warning", "off": "none"}
"""SARIF's level of each degree."""
REPORT_IT = (
    "an error of the workbench, not of the task; please report it, with the traceback that --json-file writes"
)
CANNOT_CHECK = "cannot-check"
"""Id in reports for an error that ends the check before any rule is checked. No rule has this id."""
_UNDECIDED: tuple[State, ...] = ("failed", "not_known")
_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class Reported:
    """A report, with the paths and options that are needed to print it or write it to files."""

    report: CheckReport
    what: CheckOptions
    root: Path
    """The current folder of the command."""
    fail_on: FailOn
    error: Problem | None = None
    """Why no rule was checked; None if rules were checked."""

    def fails(self, finding: Finding) -> bool:
        return fails(finding.degree, self.fail_on)

    @property
    def place_of_error(self) -> tuple[str, int | None] | None:
        """File and line of the error; if no line is known, the task's file without a line."""
        error, file = self.error, self.report.task.file
        if error is not None and error.file is not None:
            return error.file, error.line
        return None if file is None else (file, None)


def count_text(count: int, what: str) -> str:
    """``1 finding``, ``3 findings``."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def shown_path(file: str, root: Path) -> str:
    """Path of the file: relative to `root` if the file is below `root`, else as given."""
    path = Path(file)
    return str(path.relative_to(root)) if path.is_relative_to(root) else file


def repository_of(folder: Path) -> Path:
    """Root of the git checkout that contains the folder; the folder itself if there is none. CI expects paths
    relative to this root."""
    return next((each for each in (folder, *folder.parents) if (each / ".git").exists()), folder)


# --- JSON ------------------------------------------------------------------------------------------------


def as_json(reported: Reported) -> str:
    """The whole report as one JSON object."""
    report, what = reported.report, reported.what
    task = report.task
    return json_text(
        {
            "task": {
                "id": task.env_id,
                "class": task.class_name,
                "file": None if task.file is None else shown_path(task.file, reported.root),
                "not_checked": list(task.others),
            },
            "num_envs": what.options.num_envs,
            "seeds": what.seeds,
            "first_seed": what.options.seed,
            "actions": what.actions,
            "seconds": round(report.seconds, 3),
            "start_seconds": round(report.start_seconds, 3),
            "picture_seconds": round(report.picture_seconds, 3),
            "fail_on": reported.fail_on,
            "fails": reported.error is not None or report.fails(reported.fail_on),
            "error": _error(reported),
            "counts": dict(Counter(result.state for result in report.results)),
            "findings": [_finding(finding, reported.root) for finding in report.findings],
            "rules": [_rule(result, reported.root) for result in report.results],
            "ignored": list(report.ignored),
            "comments": [
                {"file": shown_path(one.file, reported.root), "line": one.line, "message": one.message}
                for one in report.comments
            ],
        }
    )


def _error(reported: Reported) -> dict[str, Any] | None:
    return None if reported.error is None else _problem(reported.error, reported.root)


def _problem(problem: Problem, root: Path) -> dict[str, Any]:
    return {
        "stage": problem.stage,
        "message": problem.message,
        "file": problem.file and shown_path(problem.file, root),
        "line": problem.line,
        "code": problem.code,
        "traceback": problem.traceback,
    }


def _finding(finding: Finding, root: Path) -> dict[str, Any]:
    rule = RULES[finding.rule]
    return {
        "rule": finding.rule,
        "degree": finding.degree,
        "message": finding.message,
        "file": None if finding.file is None else shown_path(finding.file, root),
        "line": finding.line,
        "code": finding.code,
        "function": finding.function,
        "count": finding.count,
        "hook": rule.hook,
        "asks": rule.asks,
        "otherwise": rule.otherwise,
    }


def _rule(result: RuleResult, root: Path) -> dict[str, Any]:
    silenced = [{**_finding(one.finding, root), "reason": one.reason} for one in result.silenced]
    return {
        "rule": result.rule,
        "state": result.state,
        "why": result.why,
        "error": None if result.problem is None else _problem(result.problem, root),
        "seconds": round(result.seconds, 3),
        "notes": list(result.notes),
        "silenced": silenced,
    }


def json_text(value: Any) -> str:
    """The value as JSON, in ASCII only."""
    # In ASCII only, because some programs cannot read file names with bytes that are not UTF-8.
    return json.dumps(value, indent=1) + "\n"


# --- JUnit -----------------------------------------------------------------------------------------------


def as_junit(reported: Reported) -> str:
    """JUnit XML with a test case for each rule, in pytest's format, which GitLab, Jenkins and GitHub Actions
    read. A finding whose degree is below ``--fail-on`` appears as output of a passing test."""
    report = reported.report
    root = repository_of(reported.root)
    cases = [_case(result, reported, root) for result in report.results]
    cases += [_ignored_case(rule, report.task.env_id) for rule in report.ignored]
    cases += [] if reported.error is None else [_error_case(reported, reported.error, root)]
    counts = {
        "tests": len(cases),
        "failures": sum(case.find("failure") is not None for case in cases),
        "errors": sum(case.find("error") is not None for case in cases),
        "skipped": sum(case.find("skipped") is not None for case in cases),
    }
    totals = {**{name: str(count) for name, count in counts.items()}, "time": f"{report.seconds:.3f}"}
    suites = ElementTree.Element("testsuites", {"name": "workbench check", **totals})
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    named = {"name": xml_text(report.task.env_id), "timestamp": now}
    suite = ElementTree.SubElement(suites, "testsuite", {**named, **totals})
    suite.extend(cases)
    if report.comments:
        lines = [f"{shown_path(one.file, root)}:{one.line}: {one.message}" for one in report.comments]
        ElementTree.SubElement(suite, "system-out").text = xml_text("\n".join(lines))
    ElementTree.indent(suites)
    return ElementTree.tostring(suites, encoding="unicode", xml_declaration=True) + "\n"


def _case(result: RuleResult, reported: Reported, root: Path) -> ElementTree.Element:
    """Test case of a rule that was checked."""
    task = reported.report.task
    place = next((f for f in result.findings if f.file is not None), None)
    file = task.file if place is None else place.file
    case = _test_case(task.env_id, result.rule, result.seconds)
    if file is not None:
        case.set("file", xml_text(shown_path(file, root)))
        if place is not None and place.line is not None:
            case.set("line", str(place.line))
    failing = [finding for finding in result.findings if reported.fails(finding)]
    if failing:
        failure = ElementTree.SubElement(
            case, "failure", type=result.rule, message=xml_text(failing[0].message)
        )
        failure.text = xml_text("\n\n".join(_text(finding, root) for finding in failing))
    elif result.state in ("failed", "not_known", "not_applicable"):
        message = xml_text(f"{state_text(result.state)}: {result.why}")
        if result.problem is None or reported.fail_on == "never":
            kind = f"workbench.{result.state}"
            ElementTree.SubElement(case, "skipped", type=kind, message=message)
        else:
            kind = "workbench.failed" if result.state == "failed" else "TaskError"
            error = ElementTree.SubElement(case, "error", type=kind, message=message)
            trace = result.problem.traceback
            error.text = xml_text(f"{REPORT_IT}\n\n{trace}" if result.is_crash else result.why)
    lines = [_text(finding, root) for finding in result.findings if not reported.fails(finding)]
    lines += [f"silenced: {_text(one.finding, root)}\nreason: {one.reason}" for one in result.silenced]
    lines += result.notes
    if lines:
        ElementTree.SubElement(case, "system-out").text = xml_text("\n\n".join(lines))
    return case


def _ignored_case(rule: str, env_id: str) -> ElementTree.Element:
    case = _test_case(env_id, rule, 0)
    ElementTree.SubElement(case, "skipped", type="workbench.ignore", message="left out by --ignore")
    return case


def _error_case(reported: Reported, error: Problem, root: Path) -> ElementTree.Element:
    case = _test_case(reported.report.task.env_id, CANNOT_CHECK, reported.report.seconds)
    where = ""
    if (place := reported.place_of_error) is not None:
        file, line = shown_path(place[0], root), place[1]
        case.set("file", xml_text(file))
        if line is not None:
            case.set("line", str(line))
        where = place_text(file, line)
    found = ElementTree.SubElement(case, "error", type=xml_text(error.stage), message=xml_text(error.message))
    code = f"\n    {error.code}" if error.code else ""
    found.text = xml_text(f"{where}{error.what_failed}\n{error.message}{code}\n{error.traceback}".rstrip())
    return case


def _test_case(env_id: str, name: str, seconds: float) -> ElementTree.Element:
    classname = xml_text(f"workbench.check.{env_id}")
    return ElementTree.Element("testcase", classname=classname, name=name, time=f"{seconds:.3f}")


def _text(finding: Finding, root: Path) -> str:
    place = place_text(finding.file and shown_path(finding.file, root), finding.line)
    code = f"\n    {finding.code}" if finding.code else ""
    why = RULES[finding.rule].otherwise
    return f"{place}{finding.rule} ({finding.degree})\n{finding.message}{code}\nWhy: {why}"


def xml_text(text: str) -> str:
    """Escape the characters that XML cannot represent."""
    return _NOT_IN_XML.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


# --- SARIF -----------------------------------------------------------------------------------------------


def as_sarif(reported: Reported) -> str:
    """SARIF 2.1.0 with the fields that GitHub code scanning requires. Paths are relative to the repository."""
    report = reported.report
    root = repository_of(reported.root)
    ids = [*(result.rule for result in report.results), *report.ignored]
    rules = [_sarif_rule(rule) for rule in ids]
    silenced = [(one.finding, one.reason) for result in report.results for one in result.silenced]
    results = [_result(finding, ids, reported, root) for finding in report.findings]
    results += [
        {
            **_result(finding, ids, reported, root),
            "suppressions": [{"kind": "inSource", "justification": reason}],
        }
        for finding, reason in silenced
    ]
    # Undecided rules become notifications, because code scanning shows each result as an alert.
    notes = [
        {
            "level": "note" if one.problem is None else "error",
            "message": {"text": f"{one.rule} {state_text(one.state)}: {one.why}"},
            "associatedRule": {"id": one.rule, "index": ids.index(one.rule)},
        }
        for state in _UNDECIDED
        for one in report.of_state(state)
    ]
    notes += [
        {
            "level": "warning",
            "message": {"text": comment.message},
            "locations": [_location(comment.file, comment.line, root)],
        }
        for comment in report.comments
    ]
    if reported.error is not None:
        results.append(_error_result(reported, reported.error, root))
        rules.append(_ERROR_RULE)
    off = [
        {"descriptor": {"id": rule, "index": ids.index(rule)}, "configuration": {"enabled": False}}
        for rule in report.ignored
    ]
    driver = {
        "name": "workbench check",
        "semanticVersion": version(DISTRIBUTION),
        "rules": rules,
    }
    ran = reported.error is None and not report.stopped and all(one.problem is None for one in report.results)
    run = {
        "tool": {"driver": driver},
        "originalUriBaseIds": {"%SRCROOT%": {"uri": f"{root.as_uri()}/"}},
        "invocations": [
            {
                "executionSuccessful": ran,
                "toolExecutionNotifications": notes,
                **({"ruleConfigurationOverrides": off} if off else {}),
            }
        ],
        "columnKind": "unicodeCodePoints",
        "results": results,
    }
    return json_text({"$schema": SCHEMA, "version": "2.1.0", "runs": [run]})


_ERROR_RULE = {
    "id": CANNOT_CHECK,
    "shortDescription": {"text": "Task and policy can be imported, and what they need is downloaded."},
    "fullDescription": {"text": "Without that, no rule can be checked."},
    "help": {"text": "Fix this line, or download what is missing, and check again."},
    "defaultConfiguration": {"level": "error"},
}


def _error_result(reported: Reported, error: Problem, root: Path) -> dict[str, Any]:
    place = reported.place_of_error
    key = [CANNOT_CHECK, shown_path(place[0] if place else "", root), error.code or ""]
    return {
        "ruleId": CANNOT_CHECK,
        "ruleIndex": 0,
        "level": "error",
        "message": {"text": f"{error.what_failed}: {error.message}"},
        "locations": [] if place is None else [_location(*place, root)],
        "partialFingerprints": {"primaryLocationLineHash": _fingerprint(key)},
    }


def _sarif_rule(rule_id: str) -> dict[str, Any]:
    rule = RULES[rule_id]
    page = find_topic(rule_id)
    words = f"{rule.asks} If broken: {rule.otherwise}"
    return {
        "id": rule.id,
        "shortDescription": {"text": rule.asks},
        "fullDescription": {"text": words},
        "help": {
            "text": words if page is None else page.text,
            "markdown": words if page is None else page.text,
        },
        "defaultConfiguration": {"level": LEVELS[rule.degree]},
        "properties": {"tags": ["maniskill", rule.hook]},
    }


def _result(finding: Finding, ids: list[str], reported: Reported, root: Path) -> dict[str, Any]:
    # Code scanning shows no result without a place: fall back to the first line of the task's file.
    file = finding.file or reported.report.task.file
    key = [finding.rule, shown_path(file or "", root), finding.function, finding.code]
    return {
        "ruleId": finding.rule,
        "ruleIndex": ids.index(finding.rule),
        "level": LEVELS[finding.degree],
        "message": {"text": finding.message},
        "locations": [] if file is None else [_location(file, finding.line, root)],
        "partialFingerprints": {"primaryLocationLineHash": _fingerprint(key)},
    }


def _fingerprint(key: list[str]) -> str:
    return f"{hashlib.sha256(json.dumps(key).encode()).hexdigest()[:16]}:1"


def _location(file: str, line: int | None, root: Path) -> dict[str, Any]:
    """SARIF location; line 1 if the line is unknown, because code scanning shows no result without a line."""
    path = Path(file)
    if path.is_relative_to(root):
        place = {"uri": quote(path.relative_to(root).as_posix()), "uriBaseId": "%SRCROOT%"}
    else:
        place = {"uri": path.as_uri()}
    return {"physicalLocation": {"artifactLocation": place, "region": {"startLine": line or 1}}}
