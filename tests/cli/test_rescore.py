"""The output of ``workbench rescore`` on wide and narrow terminals."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from tests.drive.episodes import made, write
from workbench.cli.arguments import JobArguments
from workbench.cli.output import Exit
from workbench.cli.rescore import (
    RescoreOptions,
    RescoreOutput,
    print_verdicts,
    rescore_all,
    rescore_in_terminal,
)
from workbench.episodes.row import Source, UnreadableRecording
from workbench.rescore.job import RescoredRecording, RescoreSetup
from workbench.rescore.verdict import Verdict
from workbench.task.description import TaskOptions
from workbench.task.problem import Problem, TaskError

NAME = "WorkbenchPushCube-v1_seed626610453_env00_2026-11-22T01-07-22"
VERDICTS = [
    Verdict(
        Source(Path("a.json"), None, "a", NAME), seed=626610453, length=30, returns=(3.268, 4.902), metres=0.0
    ),
    Verdict(Source(Path("b.json"), None, "b", NAME + "-2"), why_not="it does not hold the text of its task"),
]


@pytest.mark.parametrize("width", [60, 80, 200])
def test_names_are_not_truncated_on_a_terminal_of_any_width(width: int) -> None:
    out = io.StringIO()
    print_verdicts(VERDICTS, Console(file=out, width=width))
    lines = out.getvalue().splitlines()
    beginnings = [line for line in lines if line.startswith("Workbench")]
    assert [line.split()[0] for line in beginnings] == [NAME, NAME + "-2"]
    assert "3.268 → 4.902" in out.getvalue() and "626610453" in out.getvalue()
    assert (lines[0].split()[0] == "episode") == (width == 200), "a table where there is room for one"


def told(verdicts: list[Verdict[Source]]) -> str:
    out = io.StringIO()
    print_verdicts(verdicts, Console(file=out, width=300))
    return out.getvalue()


def verdict(number: int, **more: Any) -> Verdict[Source]:
    return Verdict(Source(Path(f"/r/{number}.json"), None, str(number), f"name{number}"), length=5, **more)


def test_of_many_recordings_the_table_lists_those_that_need_a_look() -> None:
    looks: list[dict[str, Any]] = [
        {"first_difference": 2, "differing": ("reward",), "largest": 0.5},
        {"differing": ("height",)},
        {"metres": 0.5},
        {"why_not": "no source"},
    ]
    alike = [verdict(number) for number in range(4, 30)]
    some = [verdict(number, **more) for number, more in enumerate(looks)]
    few = told([*alike, *some])
    assert all(f"name{number} " in few for number in range(30)), "up to 30 are all listed"
    many = told([*alike, *some, verdict(30)])
    listed = {word for word in many.split() if word.startswith("name")}
    assert listed == {f"name{number}" for number in range(4)}
    assert many.splitlines()[-2].startswith("27 ")


def test_cells_of_a_recording_without_a_verdict_stay_empty() -> None:
    row = told([verdict(1, seed=4, why_not="no [source]", metres=0.5)]).splitlines()[1]
    assert row.split() == "name1 4 not rescored: no [source]".split()
    row = told([verdict(1, returns=(1.0, 2.0), metres=0.01)]).splitlines()[1]
    assert row.split() == "name1 5 1 → 2 unchanged 1 cm".split()


# --- which code rescores, and what a failure means ---------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of two registered tasks, whose names are not in the order of the tasks."""
    folder = tmp_path_factory.mktemp("recorded")
    for name, task in (("b", "PickCube-v1"), ("a", "PushCube-v1"), ("c", "PushCube-v1")):
        path = write(folder / "one", made(3, task=task, source={}, source_file=None), pictures=False)
        for suffix in (".rrd", ".h5", ".json"):
            path.with_suffix(suffix).rename(folder / f"{name}{suffix}")
    shutil.rmtree(folder / "one")
    return folder


@pytest.fixture
def folder(child_process: None, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return Path(shutil.copytree(recorded, tmp_path / "recordings"))


PROBLEM = Problem("build", "it broke", "task.py", 3, "1 / 0", "Traceback")


def rescoring(
    monkeypatch: pytest.MonkeyPatch, failing: set[str], seen: list[RescoreSetup] | None = None
) -> None:
    """Replace the work: recordings with these names fail."""

    def rescored(setup: RescoreSetup, *_: object) -> list[RescoredRecording]:
        if seen is not None:
            seen.append(setup)
        found = []
        for of in setup.items.values():
            fails = of.name in failing
            made = replace(
                of.verdict("it broke" if fails else of.why_not), of=Source(Path("/far"), None, of.id)
            )
            problem = PROBLEM if fails else None
            found.append(
                RescoredRecording(of.place, made, of.note, failed=fails or of.refused, problem=problem)
            )
        return sorted(found, key=lambda one: one.place)

    monkeypatch.setattr("workbench.cli.rescore.rescore_recordings", rescored)


def test_verdicts_are_in_file_order_and_each_task_is_loaded_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[RescoreSetup] = []
    rescoring(monkeypatch, set(), seen)
    (folder / "d.json").write_text("{")
    (folder / "d.h5").write_bytes(b"")
    base = TaskOptions(num_envs=9, rules="off")
    verdicts, _ = rescore_all(RescoreOptions((folder,), num_envs=1, base=base, use_env_states=True))
    assert [one.of.path.stem for one in verdicts] == ["a", "b", "c", "d"]
    assert [bool(one.why_not) for one in verdicts] == [False, False, False, True] and verdicts[3].damaged
    (setup,) = seen
    codes = [code and str(code.task) for code in setup.codes]
    assert codes == ["PushCube-v1", "PickCube-v1", None] and setup.use_env_states and setup.chunk == 1
    by_code = {place: codes[setup.of_chunk[number // setup.chunk]] for number, place in
               ((number, of.name[:1]) for number, of in setup.items.items())}  # fmt: skip
    assert by_code == {"a": "PushCube-v1", "c": "PushCube-v1", "b": "PickCube-v1", "d": None}
    assert all(
        code is None or (code.options.num_envs, code.options.rules) == (1, "off") for code in setup.codes
    )
    seen.clear()
    rescore_all(RescoreOptions((folder / "a.json",), task="PickCube-v1"))
    (code,) = seen[0].codes
    assert code is not None and str(code.task) == "PickCube-v1" and code.recorded is None
    monkeypatch.setattr(
        "workbench.cli.rescore.find_all_sources", lambda _: (Source(folder, "set/0", "1", "set"),)
    )
    with pytest.raises(UnreadableRecording):
        rescore_all(RescoreOptions((folder,)))


def test_an_error_of_one_task_is_raised_only_if_no_task_gave_a_verdict(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    what = RescoreOptions((folder,))
    for failing in ({"b"}, {"a", "c"}, {"a", "b"}):
        rescoring(monkeypatch, failing)
        verdicts, _ = rescore_all(what)
        assert {one.of.name for one in verdicts if one.why_not} == failing
    rescoring(monkeypatch, {"a", "b", "c"})
    with pytest.raises(TaskError) as raised:
        rescore_all(what)
    assert raised.value.problem == PROBLEM


def test_the_exit_code_and_the_files_of_a_rescoring(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rescoring(monkeypatch, set())
    what, run = RescoreOptions((folder,)), JobArguments(workers=1)
    files = RescoreOutput(csv_file=folder / "t.csv", json_file=folder / "t.out")
    assert rescore_in_terminal(what, files, False, run) == Exit.DONE
    assert [row["episode"] for row in json.loads((folder / "t.out").read_text())] == ["a", "b", "c"]
    assert (folder / "t.csv").read_text().count("\n") == 4 and "a" in capsys.readouterr().out
    for printed, file in (({"csv": True}, "t.csv"), ({"json": True}, "t.out")):
        assert rescore_in_terminal(what, RescoreOutput(**printed), False, run) == Exit.DONE  # type: ignore[arg-type]
        assert capsys.readouterr().out == (folder / file).read_text()
    (folder / "d.json").write_text("{")
    (folder / "d.h5").write_bytes(b"")
    assert rescore_in_terminal(what, RescoreOutput(), False, run) == Exit.FAILED
    rescoring(monkeypatch, {"a", "b", "c"})
    assert rescore_in_terminal(what, RescoreOutput(), False, run) == Exit.FAILED
    assert "task.py:3" in capsys.readouterr().err
    assert (
        rescore_in_terminal(RescoreOptions((folder / "gone",)), RescoreOutput(), False, run) == Exit.REFUSED
    )


def test_only_the_same_recordings_code_and_options_resume_a_job(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rescoring(monkeypatch, set())
    run = JobArguments(workers=1, job=folder / "a.job")
    what = RescoreOptions((folder,), task=str(folder / "task.py"))
    (folder / "task.py").write_text("x = 1\n")

    def code(**other: Any) -> int:
        return rescore_in_terminal(replace(what, **other), RescoreOutput(), True, run)

    assert code() == code() == Exit.DONE
    for other in ({"use_env_states": True}, {"base": TaskOptions(rules="off")}):
        assert code(**other) == Exit.REFUSED and "another job" in capsys.readouterr().err
    (folder / "task.py").write_text("x = 2\n")
    assert code() == Exit.REFUSED
    (folder / "task.py").write_text("x = 1\n")
    assert code() == Exit.DONE
    (folder / "c.json").unlink()
    assert code() == Exit.REFUSED
