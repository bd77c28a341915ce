"""Wrong calls of each command are refused, and the shape of machine-readable files equals the files in ``cli/``.

After an intended change of a shape, WORKBENCH_RENEW=1 rewrites the files; read the diff before committing it:

    WORKBENCH_RENEW=1 .venv/bin/python -m pytest tests/golden/test_cli.py
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
from pathlib import Path
from typing import Any, NoReturn

import pytest

from tests.drive.commands import exit_code
from tests.golden.make import GOLDEN
from workbench.cli.output import Exit

SHAPES = Path(__file__).parent / "cli"
WRONG_CALLS = {
    "workbench": ["nonsense", "--nonsense", "open --nonsense", "record"],
    "start": [
        "--num-envs 0",
        "--env control_mode",
        "--history much",
        "--memory-limit much",
        "start --host 0.0.0.0 --no-token",
    ],
    "open": [
        "open gone.py",
        "open gone.package:Task",
        "open push.py --num-envs many",
        "open push.py --num-envs 0",
        "open push.py --backend quantum",
        "open push.py --rules never",
        "open push.py --env control_mode",
        "open push.py --history much",
        "open push.py --memory-limit much",
        "open push.py --host 0.0.0.0 --no-token",
        "open push.py --debug --socket here",
    ],
    "new": [
        "new push",
        "new push-it",
        "new class",
        "new torch",
        "new pick_cube",
        "new base",
        "new stack_two --from nonsense",
    ],
    "record": [
        "record gone.py",
        "record push.py --episodes 0",
        "record push.py --episodes 1 --successes 1",
        "record push.py --workers 2 --debug",
        "record push.py --cpus-per-worker 0",
        "record push.py --shard 1/4 --successes 2",
        "record push.py --job push.py --no-pictures",
        "record push.py --upload nonsense://place",
        "record push.py --actions gone.npy",
        "record push.py --actions gone.py:act",
        "record push.py --use-env-states",
        "record push.py --out push.py",
        "record broken.py --no-pictures --episodes 1",
    ],
    "check": [
        "check",
        "check gone.py",
        "check push.py --select nonsense",
        "check push.py --select runs --ignore runs",
        "check push.py --fail-on off",
        "check push.py --sarif push.py/report.sarif",
        "check untidy.py --workers 1",
    ],
    "solve": [
        "solve",
        "solve gone.py",
        "solve push.py --rollouts 2",
        "solve push.py --method guess",
        "solve push.py --junit .",
    ],
    "sweep": [
        "sweep",
        "sweep gone.py --set a=1",
        "sweep push.py",
        "sweep push.py --set WANTED",
        "sweep push.py --set WANTED=0.1,0.1",
        "sweep push.py --set WANTDE=0.1",
        "sweep push.py --set WANTED=wide",
        "sweep push.py --set WANTED=0.1 --actions gone.npy",
    ],
    "merge": ["merge", "merge gone.job", "merge push.py"],
    "review": ["review gone", "review made --task gone.py", "review made --host 0.0.0.0 --no-token"],
    "rescore": [
        "rescore",
        "rescore gone",
        "rescore empty",
        "rescore push.py",
        "rescore made --task push.py --recorded-source",
        "rescore made --csv-file push.py/table.csv",
        "rescore made --csv --json",
        "rescore made",
    ],
    "share": [
        "share gone --sheet",
        "share made",
        "share empty --sheet",
        "share made --mp4 gone --out shared",
        "share made --sheet --out shared",
    ],
    "export": [
        "export made",
        "export gone --lerobot set",
        "export made --lerobot a --maniskill b.h5",
        "export made --lerobot set --fps 0",
        "export made --lerobot made",
        "export made --lerobot set --cameras gone",
        "export made --maniskill demos.hdf5",
        "export made --maniskill taken.h5",
        "export unsolved --maniskill demos.h5 --only-successes",
    ],
    "view": ["view gone.rrd", "view push.py", "view empty"],
    "help": ["help camera", "help sliders", "help nonsense"],
}
"""Wrong calls by command. All are refused before anything is done, except those of `ENDS`."""
ENDS = {"record broken.py --no-pictures --episodes 1": Exit.FAILED, "rescore made": Exit.NOT_TRUSTED}
"""Exit codes of the calls that start before they fail."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a task, a task that raises, foreign recordings and an empty folder."""
    folder = tmp_path_factory.mktemp("place")
    for file in (GOLDEN / "tasks" / "push").iterdir():
        if file.is_file():
            shutil.copy(file, folder)
    shutil.copytree(GOLDEN / "v1" / "tagged", folder / "made")
    shutil.copytree(GOLDEN / "v1" / "recovered", folder / "unsolved")
    (folder / "taken.json").write_text("of the user")
    (folder / "empty").mkdir()
    text = (folder / "push.py").read_text()
    assert "> WANTED" in text
    (folder / "untidy.py").write_text("import nothing_of_this_name\n")
    (folder / "broken.py").write_text(text.replace("> WANTED", "> WANTED.gone"))
    return folder


@pytest.fixture(autouse=True)
def plain_terminal(monkeypatch: pytest.MonkeyPatch, place: Path) -> None:
    """Run with 100 columns, no colours, no display and the current folder `place`; opening a page fails the test."""
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("NO_COLOR", "1")
    for name in ("FORCE_COLOR", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(place)

    def leave(code: int) -> NoReturn:
        raise AssertionError(f"a page was opened, which ends the process with {code}")

    monkeypatch.setattr(os, "_exit", leave)


def run(capsys: pytest.CaptureFixture[str], call: str) -> tuple[int, str]:
    """Return the exit code and the printed text."""
    code = exit_code(*shlex.split(call))
    return code, "".join(capsys.readouterr())


def assert_unchanged(name: str, text: str) -> None:
    """Assert that `text` equals the file `name`; with WORKBENCH_RENEW, write the file."""
    path = SHAPES / name
    if os.environ.get("WORKBENCH_RENEW"):
        path.write_text(text + "\n")
    assert text + "\n" == path.read_text()


def shape(value: Any) -> Any:
    """Replace values by their types, and a list by its distinct shapes."""
    if isinstance(value, dict):
        return {key: shape(entry) for key, entry in value.items()}
    if isinstance(value, list):
        shapes = [shape(entry) for entry in value]
        return [one for k, one in enumerate(shapes) if one not in shapes[:k]]
    return type(value).__name__


@pytest.mark.usefixtures("child_process", "renderer")
@pytest.mark.parametrize("command", WRONG_CALLS)
def test_a_wrong_call_is_refused_with_a_message(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    for call in WRONG_CALLS[command]:
        code, printed = run(capsys, call)
        assert code == ENDS.get(call, Exit.REFUSED), (call, printed)
        assert printed.strip() and "workbench/cli" not in printed, (call, printed)


@pytest.mark.usefixtures("child_process", "renderer")
def test_machine_readable_files_keep_their_shape(capsys: pytest.CaptureFixture[str]) -> None:
    """Covers rescore's table and a recording's metadata."""
    code, _ = run(capsys, "record push.py --episodes 1 --max-steps 2 --no-pictures --out new")
    assert code == Exit.DONE
    (path,) = Path("new").glob("*.json")
    # Nightly builds have another distribution name.
    text = path.read_text().replace('"mani_skill-nightly"', '"mani_skill"')
    assert_unchanged("recording.json", json.dumps(shape(json.loads(text)), indent=1))
    code, _ = run(capsys, "rescore new --task push.py --json-file table.json --csv-file table.csv")
    assert code == Exit.DONE
    assert_unchanged("rescore.json", json.dumps(shape(json.loads(Path("table.json").read_text())), indent=1))
    assert_unchanged("rescore.csv", Path("table.csv").read_text().splitlines()[0])
