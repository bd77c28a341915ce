"""What ``workbench check`` prints, writes for other programs, and exits with."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from workbench.checks.rules import RULES
from workbench.cli.main import main

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
"""One breach of a rule that stops, one of a rule that warns, one that is silenced, and a comment that silences nothing."""
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
    told = capsys.readouterr()
    return Ended(int(ended.value.code or 0), told.out, told.err)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder ``lab`` of a repository, with a task that works and one that breaks rules."""
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


def test_findings_are_told_by_degree_with_line_and_reason(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ended = run(capsys, "bad.py", "--select", RULES_OF_IT, *FEW)
    line = line_of(place / "bad.py", '"success": (distance')
    assert ended.code == 1
    stop, warn = ended.out.index("stop: 1 finding\n"), ended.out.index("warn: 1 finding\n")
    assert stop < ended.out.index(f"bad.py:{line}: success-at-reset (stop") < warn
    assert warn < ended.out.index(f"bad.py:{line}: success-and-fail (warn")
    assert f"Otherwise: {RULES['success-at-reset'].otherwise}" in ended.out
    assert '      "success": (distance < 1)' in ended.out and "workbench help success-at-reset" in ended.out
    silenced = line_of(place / "bad.py", "def compute_normalized_dense_reward")
    assert f"silenced bad.py:{silenced}: reward-normalized: {REASON}" in ended.out
    assert "2 rules kept, 2 broken, 1 silenced. " in ended.out and "s to start." in ended.out
    assert "printed by the task" in ended.err and "printed by the task" not in ended.out
    comment = line_of(place / "bad.py", "off[reward-rows]")
    assert f"bad.py:{comment}: off[reward-rows] silences nothing until a reason" in ended.err
    assert "success-and-fail: broken" in ended.err, "a line as it comes, for the log of a job"


def test_exit_codes(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def code(*arguments: str) -> int:
        return run(capsys, *arguments, *FEW).code

    assert code("good.py", "--select", RULES_OF_IT) == 0
    assert code("bad.py", "--select", "success-and-fail") == 0
    assert code("bad.py", "--select", "success-and-fail", "--fail-on", "warn") == 1
    assert code("bad.py", "--select", RULES_OF_IT, "--ignore", "success-at-reset") == 0
    (place / "gone.py").write_text("import nothing_of_this_name\n")
    assert code("gone.py") == code("nowhere.py") == code("good.py", "--select", "nonsense") == 2
    assert code("good.py", "--json-file", "nowhere/report.json") == 2
    assert not (place / "nowhere").exists()


def test_json_is_all_that_is_printed_and_equals_the_file(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ended = run(capsys, "bad.py", "--select", RULES_OF_IT, "--json", "--json-file", "report.json", *FEW)
    assert ended.code == 1
    said = json.loads(ended.out)
    assert ended.out == (place / "report.json").read_text()
    assert (said["task"]["file"], said["num_envs"], said["seeds"]) == ("bad.py", 2, 2)
    assert said["fails"] and said["fail_on"] == "stop"
    (first, second) = said["findings"]
    assert (first["rule"], first["degree"], first["file"]) == ("success-at-reset", "stop", "bad.py")
    assert first["line"] == line_of(place / "bad.py", '"success": (distance') == second["line"]
    assert {one["rule"]: one["state"] for one in said["rules"]} == {
        "reward-rows": "kept",
        "success-at-reset": "broken",
        "success-and-fail": "broken",
        "reward-finite": "kept",
        "reward-normalized": "silenced",
    }
    (silenced,) = next(one["silenced"] for one in said["rules"] if one["rule"] == "reward-normalized")
    assert silenced["reason"] == REASON and silenced["line"] and [c["line"] for c in said["comments"]]


def test_sarif_has_what_code_scanning_asks_for(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The properties that GitHub's page on SARIF support calls required, and paths from the root of the repository."""
    run(capsys, "bad.py", "--select", RULES_OF_IT, "--sarif", "report.sarif", *FEW)
    said: dict[str, Any] = json.loads((place / "report.sarif").read_text())
    assert said["version"] == "2.1.0" and said["$schema"].endswith("sarif-2.1.0.json")
    (made,) = said["runs"]
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
        cases = {case.get("name"): case for case in suite}
        assert cases.keys() == set(rules.split(","))
        assert all(case.get("classname") and float(case.get("time", "")) >= 0 for case in suite)
        for name in ("failure", "skipped", "error"):
            told = {"failure": "failures", "error": "errors"}.get(name, name)
            assert suite.get(told) == str(sum(case.find(name) is not None for case in suite))
    assert good[0].get("failures") == "0" and good[0].get("skipped") == "1"
    cases = {case.get("name"): case for case in bad[0]}
    failure = cases["success-at-reset"].find("failure")
    assert failure is not None and failure.get("type") == "success-at-reset"
    assert "lab/bad.py:" in (failure.text or "") and cases["success-at-reset"].get("file") == "lab/bad.py"
    # It does not make the exit code 1.
    assert cases["success-and-fail"].find("failure") is None
    assert "`success & ~fail`" in cases["success-and-fail"].findtext("system-out", "")
    assert REASON in cases["reward-normalized"].findtext("system-out", "")


def test_reports_hold_whatever_a_task_says(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Colours, controls and brackets: XML cannot hold some, and a terminal would obey others."""
    text = (place / "good.py").read_text()
    raises = "raise ValueError('\\x1b[2J\\x00[red]<&\\ufffe')"
    (place / "loud.py").write_text(text.replace("distance = torch.linalg.norm(self.cube", f"{raises}\n        distance = torch.linalg.norm(self.cube", 1))  # fmt: skip
    files = ("--junit", "a.xml", "--sarif", "a.sarif", "--json-file", "a.json")
    ended = run(capsys, "loud.py", "--select", "reward-finite", *files, *FEW)
    assert ended.code == 1 and "not decided reward-finite" in ended.out and "1 not decided" in ended.out
    assert "\x1b[2J" not in ended.out and "\x00" not in ended.out and "[red]<&" in ended.out
    (case,) = ElementTree.parse(place / "a.xml").getroot()[0]
    error = case.find("error")
    assert error is not None and "ValueError" in error.get("message", "") and "\\x1b[2J" in (error.text or "")
    (made,) = json.loads((place / "a.sarif").read_text())["runs"]
    assert made["invocations"][0]["executionSuccessful"] is False
    assert json.loads((place / "a.json").read_text())["rules"][0]["state"] == "failed"


def test_other_tasks_of_the_file_are_named(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    more = (
        '\n\n@register_env("WorkbenchSecond-v1", max_episode_steps=5)\nclass Second(PushCubeEnv):\n    pass\n'
    )
    (place / "good.py").write_text(TEXT + more)
    ended = run(capsys, "good.py:PushCubeEnv", "--select", "entry-name", *FEW)
    assert ended.code == 0 and "WorkbenchPushCube-v1: 1 rule kept" in ended.out
    assert "Not checked, as one task is checked at a time: good.py:Second" in ended.err


def test_the_command_as_a_job_in_ci_runs_it(place: Path, child_process: None) -> None:
    """In processes of its own, with an id that has no file here, and no terminal."""
    words = ["check", "PushCube-v1", "--num-envs", "2", "--seeds", "2", "--workers", "2"]
    words += ["--select", "success-at-reset,reward-finite", "--env", "render_backend=none", "--json"]
    ended = subprocess.run(
        [sys.executable, "-m", "workbench.cli.main", *words],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=250,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    assert ended.returncode == 0, ended.stderr
    said = json.loads(ended.stdout)
    assert said["task"]["id"] == "PushCube-v1" and said["counts"] == {"kept": 2}
