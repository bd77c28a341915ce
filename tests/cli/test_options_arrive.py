"""Every option of every command reaches the function that carries the command out, and no other option."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.drive.commands import exit_code
from workbench.checks.job_items import CheckOptions
from workbench.cli.arguments import JobArguments, imported, separated, why_unwritable
from workbench.cli.check import CheckOutput
from workbench.cli.merge import MergeOutput
from workbench.cli.rescore import RescoreOptions, RescoreOutput
from workbench.cli.solve import SolveOutput
from workbench.cli.sweep import SweepOutput
from workbench.episodes.lerobot.export import ExportOptions
from workbench.episodes.lerobot.format import Choice
from workbench.live.process.memory_limit import parse_memory
from workbench.live.process.supervisor import WorkerOptions
from workbench.page.door.gated_server import ServerOptions
from workbench.page.widgets.editor_links import parse_editor
from workbench.planning.options import PlanOptions
from workbench.record.job_worker import RecordOptions
from workbench.solve.job import SolveOptions
from workbench.sweep.job import Setting, SweepOptions
from workbench.task.description import TaskOptions

Called = tuple[Any, ...]
Run = Callable[[str, str], Called]


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a task file, a module and a folder of recordings."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "task.py").write_text("class Task(BaseEnv): pass\n")
    (tmp_path / "ids.py").touch()
    (tmp_path / "made").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("workbench.episodes.reader.reading.start_reading", lambda: None)
    for module in ("main", "job_commands"):
        monkeypatch.setattr(f"workbench.cli.{module}.use_private_driver", lambda: None)
    return tmp_path


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs a command line with the function at this place replaced; returns what the function got."""

    def run(function: str, line: str) -> Called:
        got: list[Called] = []

        def take(*given: Any) -> int:
            got.append(given)
            return 7

        monkeypatch.setattr(f"workbench.cli.{function}", take)
        assert exit_code(*shlex.split(line)) == 7, "the exit code is that of the function"
        (given,) = got
        return given

    return run


ENVS = "--num-envs 6 --backend cpu --rules stop --import ids --seed 5 --env size=0.5 --env robot_uids=fetch"
OPTIONS = TaskOptions(6, "cpu", 5, {"size": 0.5, "robot_uids": "fetch"}, rules="stop", imports=("ids",))
PLAN = "--method cem --rollouts 32 --horizon 0.4 --knots 5 --noise 0.3 --temperature 0.1 --elites 0.2 --rounds 2 --every 3"
PLANNED = PlanOptions("cem", 32, 0.4, 5, 0.3, 0.1, 0.2, 2, 3)
JOB = "--workers 2 --cluster here:1 --cpus-per-worker 3 --gpus-per-worker 0.5 --job a.job --shard 2/3"
WHERE = JobArguments(2, "here:1", 3, 0.5, Path("a.job"), "2/3")
PAGE = "--host localhost --port 9 --no-token"
SERVER = ServerOptions("localhost", 9, None, False)
EDITOR = "--editor my://{file}:{line}"


def test_pages(run: Run, place: Path) -> None:
    worker = WorkerOptions(parse_memory("3GB"), False)
    common = f"{ENVS} {PAGE} --recordings made --history 2MB --memory-limit 3GB --no-spare --trust {EDITOR}"
    address = parse_editor("my://{file}:{line}")
    started = OPTIONS, SERVER, worker, Path("made"), 2 << 20, True, address
    assert run("page.start_in_terminal", f"start {common}") == started
    assert run("page.start_in_terminal", common) == started, "the default command"
    defaults = TaskOptions(16, "auto"), ServerOptions(), WorkerOptions(parse_memory("auto"), True)
    assert run("page.start_in_terminal", "") == (
        *defaults, Path("recordings"), 256 << 20, False, parse_editor("vscode"),
    )  # fmt: skip
    opened = run("page.open_in_terminal", f"open task.py {common} --pictures fast")
    assert opened == ("task.py", *started, "fast")
    debugged = run("page.open_in_terminal", "open task.py --debug-port 0 --debug-wait")
    assert debugged[0] == "task.py" and debugged[1:3] == defaults[:2] and debugged[6:9:2] == (False, "auto")
    assert debugged[3].debug_port > 0 and debugged[3].debug_wait
    assert run("page.open_in_terminal", "open task.py")[3] == defaults[2], "no debugger unless asked for"
    socket = run("page.open_in_terminal", "open task.py --socket here")[2]
    assert socket == ServerOptions(socket=Path("here"))
    reviewed = run(
        "page.review_in_terminal",
        f"review made {PAGE} --rules off --task task.py --task ids.py --import ids --trust {EDITOR}",
    )
    base = TaskOptions(rules="off", imports=("ids",))
    tasks = (Path("task.py"), Path("ids.py"))
    assert reviewed == (Path("made"), tasks, SERVER, WorkerOptions(parse_memory("auto")), base, True, address)


def test_record(run: Run) -> None:
    given = (
        "--out o --upload s3://u --episodes 5 --successes 2 --tries 9 --actions zero --use-env-states --no-pictures "
        "--fast-pictures --max-steps 4 --seconds-per-seed 2.5"
    )
    assert run("record.record_in_terminal", f"record task.py {given} {ENVS} {PLAN} {JOB}") == (
        RecordOptions(
            "task.py",
            Path("o"),
            5,
            2,
            9,
            "zero",
            True,
            False,
            True,
            4,
            2.5,
            "s3://u",
            options=OPTIONS,
            plan=PLANNED,
        ),
        WHERE,
    )
    what, where = run("record.record_in_terminal", "record task.py")
    assert what == RecordOptions("task.py", options=TaskOptions(4)) and where == JobArguments()


def test_a_debugged_recording_has_one_worker(
    run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    waited: list[object] = []
    monkeypatch.setattr("workbench.machine.processes.debugger.debug_here", waited.append)
    _, where = run("record.record_in_terminal", "record task.py --debug --job a.job")
    assert where == JobArguments(workers=1, job=Path("a.job")) and len(waited) == 1
    for wrong in ("--workers 2", "--cluster local"):
        assert exit_code(*f"record task.py --debug {wrong}".split()) == 2 and len(waited) == 1


def test_check(run: Run) -> None:
    given = "--select runs,entry-name --select info-rows --ignore time-limit --actions zero --solve --fail-on warn"
    files = "--json --json-file a.json --junit a.xml --sarif a.sarif"
    envs = "--num-envs 6 --seeds 12 --seed 5 --import ids --env size=0.5"
    what, output, _, where = run("check.check_in_terminal", f"check task.py {given} {files} {envs} {JOB}")
    options = TaskOptions(6, "cpu", 5, {"size": 0.5}, imports=("ids",))
    rules = ("runs", "entry-name", "info-rows"), ("time-limit",)
    assert what == CheckOptions("task.py", options, 12, *rules, "zero", solve=True) and where == WHERE
    assert output == CheckOutput(True, Path("a.json"), Path("a.xml"), Path("a.sarif"), "warn")
    what, output, *_ = run("check.check_in_terminal", "check task.py")
    assert what == CheckOptions("task.py", TaskOptions(8, "cpu")) and output == CheckOutput()


def test_solve(run: Run) -> None:
    given = (
        "--seeds 12 --max-steps 4 --seconds-per-seed 2.5 --pictures --out o --upload s3://u --fail-on warn"
    )
    files = "--csv --json-file a.json --csv-file a.csv --junit a.xml"
    assert run("solve.solve_in_terminal", f"solve task.py {given} {files} {ENVS} {PLAN} {JOB}") == (
        SolveOptions("task.py", Path("o"), 12, 1, True, 4, PLANNED, OPTIONS, 2.5, upload="s3://u"),
        SolveOutput(False, Path("a.json"), True, Path("a.csv"), Path("a.xml"), "warn"),
        WHERE,
    )
    assert run("solve.solve_in_terminal", "solve task.py --json")[1] == SolveOutput(json=True)


def test_sweep(run: Run) -> None:
    given = "--set a=1,2 --set b.c=x --seeds 12 --actions zero --max-steps 4 --pictures --upload s3://u"
    files = "--json-file a.json --csv-file a.csv"
    line = f"sweep task.py {given} {files} {ENVS} {PLAN} {JOB}"
    settings = Setting("a", (1, 2)), Setting("b.c", ("x",))
    what = SweepOptions(
        "task.py", settings, Path("sweeps/task"), 12, "zero", True, 4, PLANNED, OPTIONS, upload="s3://u"
    )
    output = SweepOutput(Path("a.json"), Path("a.csv"))
    assert run("sweep.sweep_in_terminal", line) == (what, output, WHERE)
    assert run("sweep.sweep_in_terminal", f"{line} --out o")[0] == replace(what, out=Path("o"))
    for task, out in (("task.py:Task", "task"), ("ids:Task", "Task"), ("PickCube-v1", "PickCube-v1")):
        assert run("sweep.sweep_in_terminal", f"sweep {task} --set a=1")[0].out == Path("sweeps", out)


def test_merge_and_rescore(run: Run) -> None:
    files = "--json-file a.json --csv-file a.csv"
    merged = run(
        "merge.merge_in_terminal",
        f"merge task.py ids.py --job a.job --out o {files} --junit a.xml --sarif a.sarif --fail-on warn",
    )
    output = MergeOutput(Path("a.json"), Path("a.csv"), Path("a.xml"), Path("a.sarif"), "warn")
    assert merged == ((Path("task.py"), Path("ids.py")), Path("a.job"), Path("o"), output)
    base = TaskOptions(6, "cpu", rules="stop", imports=("ids",))
    envs = "--num-envs 6 --backend cpu --rules stop --import ids"
    rescored = run(
        "rescore.rescore_in_terminal",
        f"rescore made ids.py --task task.py --use-env-states {envs} {JOB} {files} --json --trust",
    )
    assert rescored == (
        RescoreOptions((Path("made"), Path("ids.py")), "task.py", False, True, 6, base),
        RescoreOutput(False, Path("a.csv"), True, Path("a.json")),
        True,
        WHERE,
    )
    what, output, trust, _ = run("rescore.rescore_in_terminal", "rescore made --recorded-source --csv")
    assert (what.recorded_source, what.task, output, trust) == (True, None, RescoreOutput(csv=True), False)


def test_sharing(run: Run) -> None:
    files = (Path("made"), Path("a.rrd"))
    line = "share made a.rrd --mp4 eye --mp4 scene --html --sheet --out o"
    assert run("share.share_in_terminal", line) == (files, ("eye", "scene"), True, True, Path("o"))
    assert run("share.share_in_terminal", "share made --html") == (
        files[:1], (), True, False, Path("."),
    )  # fmt: skip
    options = "--only-successes --task 'push it' --fps 5 --cameras eye hand --state agent/qpos --environment-state extra"
    assert run("share.export_in_terminal", f"export made a.rrd --lerobot set {options}") == (
        files, Path("set"),
        ExportOptions(Choice(("agent/qpos",), ("extra",), ("eye", "hand")), True, False, "push it", 5),
    )  # fmt: skip
    assert run("share.export_in_terminal", "export made --lerobot set --only-fitting")[2] == ExportOptions(
        only_fitting=True
    )
    assert run("share.demonstrations_in_terminal", "export made --maniskill d.h5 --only-successes") == (
        files[:1], Path("d.h5"), True, False,
    )  # fmt: skip
    viewed = run("share.view_in_terminal", "view a.rrd --web --host localhost --port 9")
    assert viewed == (files[1:], True, "localhost", 9)
    assert run("new.new_in_terminal", "new push --from tabletop") == ("push", "tabletop")
    assert run("help.show_help", "help cameras") == ("cameras",)


@pytest.mark.parametrize("command", ["record", "check", "solve", "sweep", "rescore"])
def test_impossible_values_are_refused_before_anything_begins(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = "made" if command == "rescore" else "task.py"
    line = f"{command} {file}{' --set a=1' if command == 'sweep' else ''}"
    wrong = ["--num-envs 0", "--import gone_module", "--import a-b", "--workers 0"]
    wrong += [] if command == "solve" else ["--shard 3/2"]
    wrong += [] if command in ("record", "rescore") else ["--seeds 0"]
    wrong += ["--json-file gone.py/a --csv-file task.py/a"] if command not in ("record", "check") else []
    for option in wrong:
        assert exit_code(*f"{line} {option}".split()) == 2, option
        assert capsys.readouterr().out == "", option


def test_names_of_modules_files_and_rules_are_read(place: Path) -> None:
    assert separated(("a,b", "c d", "", "e")) == ("a", "b", "c", "d", "e")
    assert imported(("ids",)) == ("ids",) and "ids" not in json.__dict__
    for wrong in ("a/b.py", "gone_module", "ids."):
        with pytest.raises(ValueError, match="--import"):
            imported((wrong,))
    assert (
        why_unwritable(None, place / "new" / "deep" / "a.json") is None and (place / "new" / "deep").is_dir()
    )
    for file in (place / "made", place / "task.py" / "a.json"):
        said = why_unwritable(place / "b.json", file)
        assert said is not None and str(file) in said
