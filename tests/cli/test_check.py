"""The output, report files and exit codes of ``workbench check``."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.drive.commands import exit_code, line_of
from workbench.checks.rule_table import RULES

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
    code = exit_code("check", *arguments)
    printed = capsys.readouterr()
    return Ended(code, printed.out, printed.err)


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

    (place / "policies.py").write_text("")
    assert code("good.py", "--select", RULES_OF_IT) == 0
    assert code("bad.py", "--select", "success-and-fail", "--fail-on", "warn") == 1
    for actions in ("policies.py:gone", "nowhere.npy"):
        assert code("good.py", "--select", "runs", "--actions", actions) == 2


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
    ended = run_in_subprocess("check", "drawn.py", *FEW[:-2], "--select", "runs")
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
    words = ["check", "good.py", "--import", "breaks", "--select", rules, "--json-file", "a.json"]
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


@pytest.mark.slow
def test_merged_parts_print_the_same_as_the_whole(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def files(name: str) -> tuple[str, ...]:
        return "--json-file", f"{name}.json", "--junit", f"{name}.xml", "--sarif", f"{name}.sarif"

    few = ("bad.py", *FEW, "--select", "success-at-reset,entry-name,body-names")
    whole = run(capsys, *few, *files("whole"))
    for part in ("1/2", "2/2"):
        assert f"Part {part} is in check-{part[0]}-of-2.job" in run(capsys, *few, "--shard", part).err
    assert exit_code("merge", "check-1-of-2.job", "check-2-of-2.job", *files("merged")) == whole.code == 1
    printed = capsys.readouterr().out
    assert printed.splitlines()[:-1] == whole.out.splitlines()[:-1]
    durations = re.compile(r'"(start_|picture_)?seconds": [^,\n]*| time(stamp)?="[^"]*"')
    for kind in ("json", "sarif", "xml"):
        one, other = (
            durations.sub("", (place / f"{name}.{kind}").read_text()) for name in ("whole", "merged")
        )
        assert other == one, kind
