"""The output, report files and exit codes of ``workbench check``."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from workbench.checks.rule_table import RULES
from workbench.cli.main import main

pytestmark = pytest.mark.thorough

TEXT = (Path(__file__).parents[2] / "tasks" / "push_cube.py").read_text()
REASON = "the parts are for people"
NORMALIZED = next(line for line in TEXT.splitlines() if "def compute_normalized_dense_reward" in line)
EDITS = (
    ("import numpy as np\n", "import numpy as np\n\nprint('printed by the task')\n"),
    ('"success": (distance < GOAL_RADIUS)', '"success": (distance < 1)'),
    (
        "return self.compute_dense_reward(obs, action, info) / 3",
        "return 5 * self.compute_dense_reward(obs, action, info)",
    ),
    (NORMALIZED, f"{NORMALIZED}  # workbench: off[reward-normalized] {REASON}"),
    ("height < -0.1", "height < 1"),
    ('reward[info["fail"]] = 0', 'reward[info["fail"]] = 2  # workbench: off[reward-rows]'),
)
"""A breach of a rule that stops, one of a rule that warns, a silenced one, and a comment that silences nothing."""
RULES_OF_IT = "success-at-reset,success-and-fail,reward-normalized,reward-finite,reward-rows"
FEW = ("--num-envs", "2", "--seeds", "2", "--workers", "1", "--env", "render_backend=none")


@dataclass(frozen=True)
class Ended:
    code: int
    out: str
    err: str


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> Ended:
    with pytest.raises(SystemExit) as ended:
        main(["check", *arguments])
    printed = capsys.readouterr()
    return Ended(int(ended.value.code or 0), printed.out, printed.err)


def run_in_subprocess(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "workbench.cli.main", *words],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=250,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder ``lab`` in a repository, with a task that works and one that breaks rules."""
    (tmp_path / ".git").mkdir()
    folder = tmp_path / "lab"
    folder.mkdir()
    (folder / "good.py").write_text(TEXT)
    text = TEXT
    for old, new in EDITS:
        assert old in text, old
        text = text.replace(old, new)
    (folder / "bad.py").write_text(text)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "100")
    return folder


def line_of(file: Path, words: str) -> int:
    text = file.read_text()
    return text[: text.index(words)].count("\n") + 1


def test_findings_are_printed_by_degree_with_line_and_reason(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ended = run(capsys, "bad.py", "--select", RULES_OF_IT, *FEW)
    line = line_of(place / "bad.py", '"success": (distance')
    assert ended.code == 1
    stop, warn = ended.out.index("stop: 1 finding\n"), ended.out.index("warn: 1 finding\n")
    assert stop < ended.out.index(f"bad.py:{line}: success-at-reset (stop") < warn
    assert warn < ended.out.index(f"bad.py:{line}: success-and-fail (warn")
    assert f"Why: {RULES['success-at-reset'].otherwise}" in ended.out
    assert '      "success": (distance < 1)' in ended.out and "workbench help success-at-reset" in ended.out
    silenced = line_of(place / "bad.py", "def compute_normalized_dense_reward")
    assert f"silenced bad.py:{silenced}: reward-normalized: {REASON}" in ended.out
    assert "2 rules kept, 2 broken, 1 silenced. " in ended.out and "s to start." in ended.out
    assert "printed by the task" in ended.err and "printed by the task" not in ended.out
    comment = line_of(place / "bad.py", "off[reward-rows]")
    assert f"comment bad.py:{comment}: off[reward-rows] silences nothing until a reason" in ended.out
    assert "success-and-fail: broken" in ended.err, "a line per finished rule, for the log of a job"


def test_exit_codes(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def code(*arguments: str) -> int:
        return run(capsys, *arguments, *FEW).code

    assert code("good.py", "--select", RULES_OF_IT) == 0
    assert code("bad.py", "--select", "success-and-fail") == 0
    assert code("bad.py", "--select", "success-and-fail", "--fail-on", "warn") == 1
    assert code("bad.py", "--select", RULES_OF_IT, "--ignore", "success-at-reset") == 0
    assert code("bad.py", "--select", RULES_OF_IT, "--fail-on", "never") == 0
    (place / "gone.py").write_text("import nothing_of_this_name\n")
    assert code("gone.py") == code("nowhere.py") == code("good.py", "--select", "nonsense") == 2


def test_a_task_that_cannot_be_imported_is_an_error_in_every_report_at_its_line(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "gone.py").write_text('"""A task."""\n\nimport nothing_of_this_name\n')
    files = ("--junit", "a.xml", "--sarif", "a.sarif", "--json-file", "a.json")
    ended = run(capsys, "gone.py", "--json", *files, *FEW)
    assert ended.code == 2 and "gone.py:3: ModuleNotFoundError" in ended.err
    assert ended.out == (place / "a.json").read_text()
    report = json.loads(ended.out)
    assert report["fails"] and (report["error"]["file"], report["error"]["line"]) == ("gone.py", 3)
    assert (
        report["error"]["code"] == "import nothing_of_this_name"
        and "nothing_of" in report["error"]["message"]
    )
    (made,) = json.loads((place / "a.sarif").read_text())["runs"]
    (result,) = made["results"]
    at = result["locations"][0]["physicalLocation"]
    assert (result["level"], at["artifactLocation"]["uri"]) == ("error", "lab/gone.py")
    assert at["region"]["startLine"] == 3 and "ModuleNotFoundError" in result["message"]["text"]
    assert made["tool"]["driver"]["rules"][result["ruleIndex"]]["id"] == result["ruleId"]
    assert made["invocations"][0]["executionSuccessful"] is False
    (suite,) = ElementTree.parse(place / "a.xml").getroot()
    (case,) = suite
    error = case.find("error")
    assert (suite.get("errors"), case.get("file"), case.get("line")) == ("1", "lab/gone.py", "3")
    assert error is not None and "ModuleNotFoundError" in error.get("message", "")


def test_exactly_the_requested_number_of_seeds_is_tried(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three seeds with two envs: the fourth episode is not counted."""
    few = ("--num-envs", "2", "--seeds", "3", "--workers", "1", "--env", "render_backend=none")
    ended = run(capsys, "bad.py", "--select", "success-at-reset,success-stays-possible", "--json", *few)
    report = json.loads(ended.out)
    (finding,) = report["findings"]
    assert finding["count"] == 3 and "3 of 3 seeds (seed 0, 1, 2)" in finding["message"]
    (noted,) = (one["notes"] for one in report["rules"] if one["rule"] == "success-stays-possible")
    assert noted == ["success in 3 of 3 random episodes"]


def test_a_comment_that_no_longer_silences_anything_is_reported(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (place / "good.py").read_text()
    idle = NORMALIZED + "  # workbench: off[reward-normalized, reward-finite] they were odd"
    (place / "good.py").write_text(text.replace(NORMALIZED, idle))
    ended = run(capsys, "good.py", "--select", "reward-normalized", "--json", *FEW)
    assert ended.code == 0
    (comment,) = json.loads(ended.out)["comments"]
    assert comment["line"] == line_of(place / "good.py", "off[reward-normalized")
    assert comment["message"].startswith("off[reward-normalized] silenced nothing in this check")
    silenced = line_of(place / "bad.py", "off[reward-normalized")
    ended = run(capsys, "bad.py", "--select", "reward-normalized", "--json", *FEW)
    assert silenced not in [one["line"] for one in json.loads(ended.out)["comments"]]


def test_the_source_of_given_actions_is_named(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "policies.py").write_text(
        "import torch\n\n\ndef still(obs):\n    return torch.zeros(8)\n\n\n"
        "def wrong(obs):\n    raise KeyError('no such key')\n"
    )

    def check(actions: str) -> Ended:
        return run(capsys, "good.py", "--select", "success-stays-possible,runs", "--actions", actions, *FEW)

    ended = check("policies.py:still")
    assert ended.code == 0 and "note success-stays-possible: success in 0 of 2 given episodes" in ended.out
    ended = check("policies.py:wrong")
    assert ended.code == 1 and "not known success-stays-possible" in ended.out
    assert "policies.py:9: KeyError" in ended.out and "1 rule kept, 0 broken" in ended.out
    ended = check("policies.py:gone")
    assert ended.code == 2 and "has no function gone" in ended.err
    assert check("nowhere.npy").code == 2


def reads_render_shapes(place: Path) -> Path:
    """Write a task that needs a renderer to build, and fails without one only after it has created materials."""
    text = (place / "good.py").read_text()
    reads = 'self.goal = builder.build_kinematic(name="goal")'
    assert reads in text
    shape = "self.goal._objs[0].find_component_by_type(sapien.render.RenderBodyComponent).render_shapes[0]"
    file = place / "drawn.py"
    file.write_text(text.replace(reads, f"{reads}\n        self.shape = {shape}"))
    return file


def test_a_task_that_needs_a_renderer_but_has_none_is_reported(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = reads_render_shapes(place)
    ended = run(capsys, "drawn.py", "--select", "runs,camera-size", "--json", *FEW)
    (finding,) = json.loads(ended.out)["findings"]
    assert ended.code == 1 and finding["line"] == line_of(file, "self.shape")
    assert "built with render_backend=none: leave this argument out" in finding["message"]


@pytest.mark.slow
def test_a_task_that_needs_a_renderer_gets_one(place: Path, child_process: None) -> None:
    """The check runs in a process that has not rendered anything."""
    reads_render_shapes(place)
    words = [
        "check",
        "drawn.py",
        "--num-envs",
        "2",
        "--seeds",
        "2",
        "--workers",
        "1",
        "--select",
        "runs",
    ]
    ended = run_in_subprocess(*words)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_only_json_is_printed_and_it_equals_the_file(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ended = run(capsys, "bad.py", "--select", RULES_OF_IT, "--json", "--json-file", "report.json", *FEW)
    assert ended.code == 1
    report = json.loads(ended.out)
    assert ended.out == (place / "report.json").read_text()
    assert (report["task"]["file"], report["num_envs"], report["seeds"]) == ("bad.py", 2, 2)
    assert report["fails"] and report["fail_on"] == "stop"
    (first, second) = report["findings"]
    assert (first["rule"], first["degree"], first["file"]) == ("success-at-reset", "stop", "bad.py")
    assert first["line"] == line_of(place / "bad.py", '"success": (distance') == second["line"]
    assert {one["rule"]: one["state"] for one in report["rules"]} == {
        "reward-rows": "kept",
        "success-at-reset": "broken",
        "success-and-fail": "broken",
        "reward-finite": "kept",
        "reward-normalized": "silenced",
    }
    (silenced,) = next(one["silenced"] for one in report["rules"] if one["rule"] == "reward-normalized")
    assert silenced["reason"] == REASON and silenced["line"] and [c["line"] for c in report["comments"]]


def test_sarif_has_the_properties_that_code_scanning_requires(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The properties that GitHub's SARIF documentation requires, and paths relative to the repository's root."""
    run(capsys, "bad.py", "--select", RULES_OF_IT, "--sarif", "report.sarif", *FEW)
    report: dict[str, Any] = json.loads((place / "report.sarif").read_text())
    assert report["version"] == "2.1.0" and report["$schema"].endswith("sarif-2.1.0.json")
    (made,) = report["runs"]
    driver = made["tool"]["driver"]
    assert driver["name"] and driver["semanticVersion"]
    for rule in driver["rules"]:
        assert rule["id"] in RULES and rule["defaultConfiguration"]["level"] in ("error", "warning")
        assert all(rule[name]["text"] for name in ("shortDescription", "fullDescription", "help"))
    assert made["invocations"][0]["executionSuccessful"] is True
    levels = {}
    for result in made["results"]:
        assert driver["rules"][result["ruleIndex"]]["id"] == result["ruleId"]
        assert result["message"]["text"] and result["partialFingerprints"]["primaryLocationLineHash"]
        (location,) = result["locations"]
        at = location["physicalLocation"]
        assert at["artifactLocation"] == {"uri": "lab/bad.py", "uriBaseId": "%SRCROOT%"}
        assert at["region"]["startLine"] >= 1
        levels[result["ruleId"]] = result["level"]
        silenced = result["ruleId"] == "reward-normalized"
        assert result.get("suppressions") == (
            [{"kind": "inSource", "justification": REASON}] if silenced else None
        )
    assert levels == {
        "success-at-reset": "error",
        "success-and-fail": "warning",
        "reward-normalized": "warning",
    }
    base = made["originalUriBaseIds"]["%SRCROOT%"]["uri"]
    assert base == f"{place.parent.as_uri()}/"
    (comment,) = made["invocations"][0]["toolExecutionNotifications"]
    assert "silences nothing" in comment["message"]["text"]


def test_junit_has_a_test_case_for_each_rule(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rules = f"{RULES_OF_IT},success-flickers"
    run(capsys, "good.py", "--select", rules, "--junit", "good.xml", *FEW)
    run(capsys, "bad.py", "--select", rules, "--junit", "bad.xml", *FEW)
    good, bad = (ElementTree.parse(place / name).getroot() for name in ("good.xml", "bad.xml"))
    for root in (good, bad):
        (suite,) = root
        assert (root.tag, suite.tag, suite.get("tests")) == ("testsuites", "testsuite", "6")
        cases = {case.get("name"): case for case in suite.findall("testcase")}
        assert cases.keys() == set(rules.split(","))
        assert all(case.get("classname") and float(case.get("time", "")) >= 0 for case in cases.values())
        for name in ("failure", "skipped", "error"):
            attribute = {"failure": "failures", "error": "errors"}.get(name, name)
            assert suite.get(attribute) == str(sum(case.find(name) is not None for case in suite))
    assert good[0].get("failures") == "0" and good[0].get("skipped") == "2"
    skipped = [case.find("skipped") for case in good[0].findall("testcase")]
    assert {each.get("type") for each in skipped if each is not None} == {"workbench.not_known"}
    cases = {case.get("name"): case for case in bad[0].findall("testcase")}
    failure = cases["success-at-reset"].find("failure")
    assert failure is not None and failure.get("type") == "success-at-reset"
    assert "lab/bad.py:" in (failure.text or "") and cases["success-at-reset"].get("file") == "lab/bad.py"
    # A finding that does not set the exit code to 1 is no failure.
    assert cases["success-and-fail"].find("failure") is None
    assert "`success & ~fail`" in cases["success-and-fail"].findtext("system-out", "")
    assert REASON in cases["reward-normalized"].findtext("system-out", "")


def test_reports_stay_valid_with_any_message_of_a_task(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Colours, control characters and brackets: some are invalid in XML, others would control a terminal."""
    text = (place / "good.py").read_text()
    raises = "raise ValueError('\\x1b[2J\\x00[red]<&\\ufffe')"
    (place / "loud.py").write_text(text.replace("distance = torch.linalg.norm(self.cube", f"{raises}\n        distance = torch.linalg.norm(self.cube", 1))  # fmt: skip
    files = ("--junit", "a.xml", "--sarif", "a.sarif", "--json-file", "a.json")
    ended = run(capsys, "loud.py", "--select", "reward-finite", *files, *FEW)
    assert ended.code == 1 and "not known reward-finite" in ended.out and "1 not known" in ended.out
    assert "\x1b[2J" not in ended.out and "\x00" not in ended.out and "[red]<&" in ended.out
    (case,) = ElementTree.parse(place / "a.xml").getroot()[0]
    error = case.find("error")
    assert error is not None and "ValueError" in error.get("message", "") and "\\x1b[2J" in (error.text or "")
    (made,) = json.loads((place / "a.sarif").read_text())["runs"]
    assert made["invocations"][0]["executionSuccessful"] is False
    assert json.loads((place / "a.json").read_text())["rules"][0]["state"] == "not_known"


BREAKS = """
import os, signal
from workbench.checks.run_rules import GROUPS

def crashes(checkup):
    raise KeyError("our own mistake")

def dies(checkup):
    os.kill(os.getpid(), signal.SIGKILL)

for group in GROUPS:
    if "versioned-id" in group.checks:
        group.checks["versioned-id"] = crashes
    if "entry-name" in group.checks:
        group.checks["entry-name"] = {entry}
"""
"""Task code that breaks checks of the workbench in each process that imports it."""


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
def test_only_the_rule_whose_check_raises_fails(
    place: Path, capsys: pytest.CaptureFixture[str], child_process: None, workers: str
) -> None:
    (place / "breaks.py").write_text(BREAKS.format(entry="group.checks['entry-name']"))
    rules = "versioned-id,time-limit,success-at-reset"
    files = ("--json-file", "a.json", "--sarif", "a.sarif", "--junit", "a.xml")
    words = ["check", "good.py", "--import", "breaks", "--select", rules, *files]
    words += [*FEW[:4], "--workers", workers, "--env", "render_backend=none"]
    ended = run_in_subprocess(*words)
    report = json.loads((place / "a.json").read_text())
    assert ended.returncode == 1 and report["fails"] and report["findings"] == []
    of_rule = {one["rule"]: one for one in report["rules"]}
    states = {rule: one["state"] for rule, one in of_rule.items()}
    assert states == {"versioned-id": "failed", "time-limit": "kept", "success-at-reset": "kept"}
    error = of_rule["versioned-id"]["error"]
    assert "our own mistake" in of_rule["versioned-id"]["why"] and "in crashes" in error["traceback"]
    assert "1 failed" in ended.stdout and "please report it" in ended.stdout
    (invocation,) = json.loads((place / "a.sarif").read_text())["runs"][0]["invocations"]
    (note,) = invocation["toolExecutionNotifications"]
    assert note["level"] == "error" and note["associatedRule"]["id"] == "versioned-id"
    assert invocation["executionSuccessful"] is False
    cases = {case.get("name"): case for case in ElementTree.parse(place / "a.xml").getroot()[0]}
    broken = cases["versioned-id"].find("error")
    assert broken is not None and "in crashes" in (broken.text or "")
    assert [name for name, case in cases.items() if len(case)] == ["versioned-id"]


@pytest.mark.slow
def test_only_the_rule_that_kills_its_process_fails(place: Path, child_process: None) -> None:
    (place / "breaks.py").write_text(BREAKS.format(entry="dies"))
    rules = "entry-name,success-at-reset,info-rows,time-limit"
    words = ["check", "good.py", "--import", "breaks", "--select", rules, "--json", *FEW[:4]]
    ended = run_in_subprocess(*words, "--workers", "2", "--env", "render_backend=none")
    report = json.loads(ended.stdout)
    states = {one["rule"]: one["state"] for one in report["rules"]}
    assert ended.returncode == 1 and states.pop("entry-name") == "failed"
    assert states == {"success-at-reset": "kept", "info-rows": "kept", "time-limit": "kept"}
    (why,) = (one["why"] for one in report["rules"] if one["state"] == "failed")
    assert "SIGKILL" in why


@pytest.mark.slow
def test_the_command_as_a_job_in_ci_runs_it(place: Path, child_process: None) -> None:
    """The command runs in subprocesses, without a terminal, on an id without a file here."""
    words = ["check", "PushCube-v1", "--num-envs", "2", "--seeds", "2", "--workers", "2"]
    words += ["--select", "success-at-reset,reward-finite", "--env", "render_backend=none", "--json"]
    ended = run_in_subprocess(*words)
    assert ended.returncode == 0, ended.stderr
    report = json.loads(ended.stdout)
    assert report["task"]["id"] == "PushCube-v1" and report["counts"] == {"kept": 2}


MERGED = ("--junit", "merged.xml", "--sarif", "merged.sarif")


@pytest.mark.slow
def test_merged_parts_print_the_same_as_the_whole(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    few = ("bad.py", *FEW, "--select", "success-at-reset,entry-name,body-names")
    whole = run(capsys, *few, "--json-file", "whole.json", "--junit", "whole.xml", "--sarif", "whole.sarif")
    for part in ("1/2", "2/2"):
        assert f"Part {part} is in check-{part[0]}-of-2.job" in run(capsys, *few, "--shard", part).err
    with pytest.raises(SystemExit) as ended:
        main(["merge", "check-1-of-2.job", "check-2-of-2.job", "--json-file", "merged.json", *MERGED])
    printed = capsys.readouterr().out
    assert ended.value.code == whole.code == 1
    assert printed.splitlines()[:-1] == whole.out.splitlines()[:-1]
    report, merged = (json.loads((place / name).read_text()) for name in ("whole.json", "merged.json"))
    for one in (report, merged):
        for name in ("seconds", "start_seconds", "picture_seconds"):
            del one[name]
        for rule in one["rules"]:
            del rule["seconds"]
    assert merged == report
    assert (place / "merged.sarif").read_text() == (place / "whole.sarif").read_text()
    seconds = re.compile(r' time(stamp)?="[^"]*"')
    whole_xml, merged_xml = (
        seconds.sub("", (place / name).read_text()) for name in ("whole.xml", "merged.xml")
    )
    assert merged_xml == whole_xml
    with pytest.raises(SystemExit) as ended:
        main(["merge", "check-1-of-2.job", "check-2-of-2.job", "--csv-file", "merged.csv"])
    assert ended.value.code == 2 and "leave out --csv-file" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        main(["merge", "check-1-of-2.job", "check-2-of-2.job", "--fail-on", "never"])
    assert ended.value.code == 0
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(["merge", "check-2-of-2.job"])
    assert ended.value.code == 1 and "results of rules are in none of these files" in capsys.readouterr().out
