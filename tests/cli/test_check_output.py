"""What ``workbench check`` prints and writes of a report in which every state occurs, made by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from workbench.checks.job import CheckReport
from workbench.checks.job_items import CheckedTask, CheckOptions
from workbench.checks.results import RuleResult, Silenced
from workbench.checks.rule_table import RULES
from workbench.checks.silencing import Comment
from workbench.cli.check import CheckOutput, exit_code, print_report, write_reports
from workbench.cli.check_reports import (
    CANNOT_CHECK,
    Reported,
    as_json,
    as_junit,
    as_sarif,
    repository_of,
    shown_path,
    xml_text,
)
from workbench.cli.output import Exit
from workbench.envs.gpu_rules import FailOn, Finding
from workbench.task.description import TaskOptions
from workbench.task.problem import Problem

STOP, WARN, SILENT, CRASHED, RAISED, DIED = (
    "success-at-reset", "success-and-fail", "reward-normalized", "reward-finite", "reward-rows", "info-rows",
)  # fmt: skip
OTHERS = ("success-flickers", "success-stays-possible", "time-limit", "versioned-id")
UNKNOWN, IGNORED = "body-names", "entry-name"


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder ``lab`` of a repository, which is the current folder."""
    (tmp_path / "repo" / ".git").mkdir(parents=True)
    (tmp_path / "repo" / "lab").mkdir()
    monkeypatch.setenv("COLUMNS", "60")
    return tmp_path / "repo" / "lab"


def finding(rule: str, degree: Any, file: str | None, line: int | None, **more: Any) -> Finding:
    given = {"message": f"about [{rule}]", "code": f"code of {rule}", "function": "evaluate", "count": 1}
    return Finding(rule, degree, file=file, line=line, first_step=0, **{**given, **more})


def reported(root: Path, fail_on: FailOn = "stop", **more: Any) -> Reported:
    here, beside, far = str(root / "task.py"), str(root.parent / "lib" / "my file.py"), "/opt/lab/far.py"
    trace = Problem("evaluate", "it crashed", "/w/rules.py", 1, "", "Traceback\n  in crashes")
    raised = Problem("reward", "it raised", here, 9, "raise", "Traceback\n  in task")
    died = Problem("worker", "the worker was killed", None, None, None, "")
    results = (
        RuleResult(STOP, "broken", (finding(STOP, "stop", here, 3, count=4),), seconds=1.25),
        RuleResult(
            WARN,
            "broken",
            (
                finding(WARN, "warn", beside, 5),
                finding(WARN, "warn", far, 6, code=""),
                finding(WARN, "warn", None, None),
            ),
        ),
        RuleResult(
            SILENT, "silenced", silenced=(Silenced(finding(SILENT, "warn", here, 7), "on purpose", 7),)
        ),
        RuleResult(CRASHED, "failed", why="it crashed", problem=trace),
        RuleResult(RAISED, "not_known", why="it raised", problem=raised),
        RuleResult(DIED, "failed", why="the worker was killed", problem=died),
        *(RuleResult(rule, "not_applicable", why="it has no success") for rule in OTHERS),
        RuleResult(UNKNOWN, "not_known", why="no episode", notes=("a note",)),
        RuleResult("runs", "kept", seconds=0.5),
    )
    task = CheckedTask("Push-v1", "PushEnv", here, others=("Pull", "Stack"), notices=("a notice",))
    comments = (Comment(here, 11, "off[x] silences nothing"),)
    report = CheckReport(task, results, 5.0, 2.0, 1.5, ignored=(IGNORED,), comments=comments)
    what = CheckOptions("task.py", TaskOptions(num_envs=8, seed=3), seeds=4, actions="zero")
    return Reported(replace(report, **more), what, root, fail_on)


def test_every_state_is_printed(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    print_report(reported(root))
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert lines.index("stop: 1 finding") < lines.index("warn: 3 findings")
    assert f"task.py:3: {STOP} (stop, 4 times)" in lines and f"  about [{STOP}]" in lines
    assert f"      code of {STOP}" in lines and f"  Why: {RULES[STOP].otherwise}" in lines
    assert f"  workbench help {STOP}" in lines
    at = [line for line in lines if line.endswith(f"{WARN} (warn)")]
    assert [line.partition(WARN)[0] for line in at] == [
        f"{root.parent / 'lib' / 'my file.py'}:5: ", "/opt/lab/far.py:6: ", "",
    ]  # fmt: skip
    assert f"failed {CRASHED}: it crashed" in lines and f"failed {DIED}: the worker was killed" in lines
    (crashed,) = [line for line in lines if line.startswith(f"{CRASHED}: ")]
    assert "--json-file" in crashed
    assert f"silenced task.py:7: {SILENT}: on purpose" in lines
    assert "comment task.py:11: off[x] silences nothing" in lines
    assert f"not known {RAISED}: it raised" in lines and f"not known {UNKNOWN}: no episode" in lines
    first = lines.index("not applicable it has no success")
    assert lines[first + 1] == "    4 rules:"
    assert " ".join(lines[first + 2 : first + 4]).split() == [*(f"{one}," for one in OTHERS[:3]), OTHERS[3]]
    assert f"1 ignored: {IGNORED}" in lines and f"note {UNKNOWN}: a note" in lines
    assert lines[-1] == (
        "Push-v1: 1 rule kept, 2 broken, 1 silenced, 4 not applicable, 2 not known, 2 failed, 1 ignored. "
        "5.0 s, of which 2.0 s to start and 1.5 s for the first pictures."
    )
    notice, others = printed.err.splitlines()
    assert notice == "a notice" and others.endswith("task.py:Pull, task.py:Stack")


@pytest.mark.parametrize(
    ("fail_on", "more", "code"),
    [
        ("stop", {}, Exit.FAILED),
        ("never", {}, Exit.DONE),
        ("warn", {"results": (RuleResult(STOP, "kept"),)}, Exit.DONE),
        ("stop", {"results": (RuleResult(WARN, "broken", (finding(WARN, "warn", None, None),)),)}, Exit.DONE),
        (
            "warn",
            {"results": (RuleResult(WARN, "broken", (finding(WARN, "warn", None, None),)),)},
            Exit.FAILED,
        ),
        ("stop", {"results": (RuleResult(CRASHED, "failed", why="it crashed"),)}, Exit.FAILED),
    ],
)
def test_the_exit_code_follows_the_degree_and_the_reports_agree(
    root: Path, fail_on: FailOn, more: dict[str, Any], code: Exit
) -> None:
    one = reported(root, fail_on, **more)
    assert exit_code(one) == code
    report = json.loads(as_json(one))
    assert report["fails"] == (code is Exit.FAILED) and report["fail_on"] == fail_on
    suite = ElementTree.fromstring(as_junit(one))[0]
    assert (suite.get("failures"), suite.get("errors")) == ("0", "0") or code is Exit.FAILED


def test_the_json_has_all_of_it(root: Path) -> None:
    report = json.loads(as_json(reported(root)))
    assert report["task"] == {
        "id": "Push-v1", "class": "PushEnv", "file": "task.py", "not_checked": ["Pull", "Stack"],
    }  # fmt: skip
    assert (report["num_envs"], report["seeds"], report["first_seed"], report["actions"]) == (8, 4, 3, "zero")
    assert (report["seconds"], report["start_seconds"], report["picture_seconds"]) == (5.0, 2.0, 1.5)
    assert report["counts"] == {
        "broken": 2, "silenced": 1, "failed": 2, "not_known": 2, "not_applicable": 4, "kept": 1,
    }  # fmt: skip
    assert [(one["file"], one["line"]) for one in report["findings"]] == [
        ("task.py", 3), (str(root.parent / "lib" / "my file.py"), 5), ("/opt/lab/far.py", 6), (None, None),
    ]  # fmt: skip
    stop = report["findings"][0]
    assert (stop["rule"], stop["degree"], stop["count"], stop["function"]) == (STOP, "stop", 4, "evaluate")
    assert (stop["hook"], stop["asks"]) == (RULES[STOP].hook, RULES[STOP].asks)
    assert stop["otherwise"] == RULES[STOP].otherwise and stop["code"] == f"code of {STOP}"
    of = {one["rule"]: one for one in report["rules"]}
    assert of[STOP]["seconds"] == 1.25 and of[UNKNOWN]["notes"] == ["a note"]
    assert of[SILENT]["silenced"][0]["reason"] == "on purpose" and of[SILENT]["silenced"][0]["line"] == 7
    error = of[RAISED]["error"]
    assert (error["file"], error["line"], error["stage"]) == ("task.py", 9, "reward")
    assert "in task" in error["traceback"] and of[STOP]["error"] is None
    assert report["ignored"] == [IGNORED] and report["error"] is None
    assert report["comments"] == [{"file": "task.py", "line": 11, "message": "off[x] silences nothing"}]


def test_junit_has_a_case_of_each_rule_by_its_result(root: Path) -> None:
    suites = ElementTree.fromstring(as_junit(reported(root)))
    (suite,) = suites
    assert (suites.tag, suite.tag) == ("testsuites", "testsuite")
    assert {name: suite.get(name) for name in ("tests", "failures", "errors", "skipped", "time")} == {
        "tests": "13", "failures": "1", "errors": "3", "skipped": "6", "time": "5.000",
    }  # fmt: skip
    assert suite.get("name") == "Push-v1" and all(
        suites.get(name) == suite.get(name) for name in ("tests", "errors")
    )
    cases = {case.get("name") or "": case for case in suite.findall("testcase")}
    of = {name: [child.tag for child in case] for name, case in cases.items()}
    assert of[STOP] == ["failure"] and of[WARN] == ["system-out"] and of[SILENT] == ["system-out"]
    assert of[CRASHED] == of[RAISED] == of[DIED] == ["error"] and of[IGNORED] == ["skipped"]
    assert of[UNKNOWN] == ["skipped", "system-out"] and all(of[rule] == ["skipped"] for rule in OTHERS)
    assert (cases[STOP].get("file"), cases[STOP].get("line")) == ("lab/task.py", "3")
    assert (cases[WARN].get("file"), cases[WARN].get("line")) == ("lib/my file.py", "5")
    assert (cases[UNKNOWN].get("file"), cases[UNKNOWN].get("line")) == ("lab/task.py", None)
    assert cases[STOP].get("time") == "1.250" and cases[STOP].get("classname") == "workbench.check.Push-v1"
    texts = {name: case.findtext("failure") or case.findtext("error") or "" for name, case in cases.items()}
    assert f"lab/task.py:3: {STOP} (stop)" in texts[STOP] and f"about [{STOP}]" in texts[STOP]
    assert "in crashes" in texts[CRASHED] and texts[RAISED] == "it raised"
    kinds = {name: case[0].get("type") for name, case in cases.items() if len(case)}
    assert (kinds[STOP], kinds[CRASHED], kinds[RAISED]) == (STOP, "workbench.failed", "TaskError")
    assert f"about [{WARN}]" in cases[WARN].findtext("system-out", "")
    assert kinds[OTHERS[0]] == "workbench.not_applicable"
    out = cases[SILENT].findtext("system-out") or ""
    assert "on purpose" in out and f"about [{SILENT}]" in out
    assert "lab/task.py:11" in (suite.findtext("system-out") or "")
    # With --fail-on never, nothing is an error.
    suite = ElementTree.fromstring(as_junit(reported(root, "never")))[0]
    assert (suite.get("failures"), suite.get("errors"), suite.get("skipped")) == ("0", "0", "9")


def test_sarif_names_places_rules_and_undecided_rules(root: Path) -> None:
    report = json.loads(as_sarif(reported(root)))
    assert report["version"] == "2.1.0" and report["$schema"].endswith("sarif-2.1.0.json")
    (run,) = report["runs"]
    driver = run["tool"]["driver"]
    rules = driver["rules"]
    # What code scanning on GitHub requires.
    assert driver["name"] and driver["semanticVersion"]
    for rule in rules:
        assert rule["defaultConfiguration"]["level"] in ("error", "warning")
        assert all(rule[name]["text"] for name in ("shortDescription", "fullDescription", "help"))
    assert [rule["id"] for rule in rules][-1] == IGNORED and len(rules) == 13
    assert run["originalUriBaseIds"]["%SRCROOT%"]["uri"] == f"{root.parent.as_uri()}/"
    places = []
    for result in run["results"]:
        assert rules[result["ruleIndex"]]["id"] == result["ruleId"]
        assert result["message"]["text"] and result["partialFingerprints"]["primaryLocationLineHash"]
        at = result["locations"][0]["physicalLocation"]
        assert (
            at["artifactLocation"]["uri"].startswith("file:")
            or at["artifactLocation"]["uriBaseId"] == "%SRCROOT%"
        )
        places.append((at["artifactLocation"]["uri"], at["region"]["startLine"], result["level"]))
    assert places == [
        ("lab/task.py", 3, "error"),
        ("lib/my%20file.py", 5, "warning"),
        ("file:///opt/lab/far.py", 6, "warning"),
        ("lab/task.py", 1, "warning"),
        ("lab/task.py", 7, "warning"),
    ]
    assert run["results"][-1]["suppressions"] == [{"kind": "inSource", "justification": "on purpose"}]
    (invocation,) = run["invocations"]
    notes = invocation["toolExecutionNotifications"]
    assert [(one["level"], one.get("associatedRule", {}).get("id")) for one in notes] == [
        ("error", CRASHED), ("error", DIED), ("error", RAISED), ("note", UNKNOWN), ("warning", None),
    ]  # fmt: skip
    assert all(
        rules[one["associatedRule"]["index"]]["id"] == one["associatedRule"]["id"] for one in notes[:4]
    )
    assert notes[4]["locations"][0]["physicalLocation"]["region"]["startLine"] == 11
    (off,) = invocation["ruleConfigurationOverrides"]
    assert rules[off["descriptor"]["index"]]["id"] == IGNORED and off["configuration"] == {"enabled": False}
    assert invocation["executionSuccessful"] is False
    kept = reported(root, results=(RuleResult(UNKNOWN, "not_known", why="no episode"),), ignored=())
    (run,) = json.loads(as_sarif(kept))["runs"]
    assert run["invocations"][0]["executionSuccessful"] is True
    (run,) = json.loads(as_sarif(replace(kept, report=replace(kept.report, stopped=True))))["runs"]
    assert run["invocations"][0]["executionSuccessful"] is False


def test_the_fingerprint_of_a_finding_follows_its_code_and_not_its_line(root: Path) -> None:
    def prints(*found: Finding) -> list[str]:
        one = reported(root, results=(RuleResult(STOP, "broken", found),))
        results = json.loads(as_sarif(one))["runs"][0]["results"]
        return [result["partialFingerprints"]["primaryLocationLineHash"] for result in results]

    here = str(root / "task.py")
    first = finding(STOP, "stop", here, 3)
    others = (replace(first, code="other"), replace(first, function="reset"), replace(first, file="/x.py"))
    (moved,) = prints(replace(first, line=30, message="other words", count=9))
    found = prints(first, *others)
    assert found[0] == moved and len(set(found)) == 4


def test_an_error_without_a_line_before_any_rule_is_in_every_report(root: Path, tmp_path: Path) -> None:
    error = Problem("import", "no module", None, None, None, "Traceback\n  x")
    one = replace(reported(root, results=(), ignored=(), comments=()), error=error)
    assert exit_code(one) == Exit.REFUSED
    files = CheckOutput(json_file=tmp_path / "a.json", junit=tmp_path / "a.xml", sarif=tmp_path / "a.sarif")
    write_reports(one, files)
    assert json.loads((tmp_path / "a.json").read_text())["error"]["line"] is None
    assert json.loads((tmp_path / "a.json").read_text())["fails"] is True
    suite = ElementTree.parse(tmp_path / "a.xml").getroot()[0]
    (case,) = suite
    assert (case.get("name"), case.get("file"), case.get("line")) == (CANNOT_CHECK, "lab/task.py", None)
    text = case.findtext("error") or ""
    assert (
        (suite.get("errors"), suite.get("tests")) == ("1", "1")
        and "no module" in text
        and "Traceback" in text
    )
    (result,) = json.loads((tmp_path / "a.sarif").read_text())["runs"][0]["results"]
    place = result["locations"][0]["physicalLocation"]
    assert (place["artifactLocation"]["uri"], place["region"]["startLine"]) == ("lab/task.py", 1)
    # Of an id, no file is known.
    report = replace(one.report, task=replace(one.report.task, file=None))
    (result,) = json.loads(as_sarif(replace(one, report=report)))["runs"][0]["results"]
    assert not result["locations"]


def test_paths_are_shown_below_their_root(root: Path) -> None:
    assert shown_path(str(root / "sub" / "a.py"), root) == "sub/a.py"
    assert shown_path("/elsewhere/a.py", root) == "/elsewhere/a.py"
    assert repository_of(root / "sub") == root.parent
    assert repository_of(Path("/")) == Path("/")
    assert xml_text("a\x00\x1b[2J\ufffe\n\té") == "a\\x00\\x1b[2J\\ufffe\n\té"
