"""This version lists recordings of older versions, reads them to the last bit, rescores them equally and continues them live."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.drive.commands import exit_code
from tests.drive.session import live_session, wait_until
from tests.golden.make import GOLDEN, expected_of, read_folder
from workbench.app.session import Session
from workbench.cli.output import Exit
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.recorded_source import run_of
from workbench.episodes.row import UnreadableRecording
from workbench.library.folder import Library
from workbench.live.commands import Step
from workbench.live.events import SlidersMoved

# Recordings are read, recovered and entered in child processes; one is recorded in this process, which needs a renderer.
pytestmark = pytest.mark.usefixtures("child_process", "renderer")

SETS = sorted(path.name for path in GOLDEN.glob("v*"))
assert SETS, "without a set, no test of this file would run"
KINDS = ("cameras", "several", "tagged", "recovered", "damaged")
TOLERANCE_METRES = 1e-4
"""README's tolerance for equal places; results are equal to the last bit only on the CPU model that recorded them."""


@pytest.fixture(scope="module", params=SETS)
def place(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of one set, next to the tasks that it names."""
    folder = tmp_path_factory.mktemp("golden")
    shutil.copytree(GOLDEN / "tasks", folder / "tasks", ignore=shutil.ignore_patterns("__pycache__"))
    return Path(shutil.copytree(GOLDEN / request.param, folder / request.param))


@pytest.fixture(scope="module")
def expected(place: Path) -> dict[str, Any]:
    return json.loads((place / "expected.json").read_text())


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Run a command in this process; return its exit code, stdout and stderr."""
    code = exit_code(*arguments)
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_the_library_lists_golden_recordings(place: Path, expected: dict[str, Any]) -> None:
    library = Library(place)
    library.refresh()
    rows = {row.name: row for row in library.view().rows}
    pictured = {name for name, row in rows.items() if library.thumbnails((row.id,))}
    library.close()
    assert sorted(rows) == sorted(f"{kind}/{name}" for kind in KINDS for name in expected[kind])
    for kind in KINDS:
        for name, facts in expected[kind].items():
            row = rows[f"{kind}/{name}"]
            assert (row.kind, row.task, row.seed) == ("workbench", facts["task"], facts["seed"])
            assert row.length == len(facts["reward"])
            assert row.total_reward == pytest.approx(sum(facts["reward"]))
            assert row.success is (kind != "recovered")
            assert row.recovered is (kind == "recovered")
            assert row.tags == (("good", "slips") if kind == "tagged" else ())
            assert row.note == ("the box turns a little" if kind == "tagged" else "")
            # The library checks only lengths: opening the file finds the flipped bit.
            assert bool(row.problem) is (kind == "damaged" and name not in not_cut(place))
    assert pictured == {f"cameras/{name}" for name in expected["cameras"]}


def not_cut(place: Path) -> list[str]:
    """Return the damaged episodes whose .rrd has its full length."""
    return [path.stem for path in (place / "damaged").glob("*.rrd") if path.stat().st_size != 30_000]


@pytest.mark.parametrize("kind", ["cameras", "several", "tagged", "recovered"])
def test_golden_recordings_are_read_to_the_last_bit(place: Path, expected: dict[str, Any], kind: str) -> None:
    assert_as_expected(read_folder(place / kind), expected[kind])


def assert_as_expected(found: dict[str, Any], expected: dict[str, Any]) -> None:
    plain = [{name: {**facts, "colour": None} for name, facts in read.items()} for read in (found, expected)]
    assert plain[0] == plain[1]
    for name, facts in expected.items():
        assert found[name]["colour"].keys() == facts["colour"].keys()
        for camera, means in facts["colour"].items():
            np.testing.assert_allclose(found[name]["colour"][camera], means, atol=0.5)


def test_a_damaged_recordings_file_is_named_and_the_rest_is_read(
    place: Path, expected: dict[str, Any]
) -> None:
    cut, turned, both = sorted((place / "damaged").glob("*.json"))
    whole, lost_of_cut = expected["damaged"], ("poses", "evaluate/pushed")
    for path, broken, lost in ((cut, ".rrd", lost_of_cut), (turned, ".h5", ("env_states/",))):
        episode = read_episode(path)
        assert [one.file for one in episode.broken_files] == [f"{path.stem}{broken}"]
        columns = whole[path.stem]["columns"]
        remaining = {name: digest for name, digest in columns.items() if not name.startswith(lost)}
        assert len(remaining) < len(columns) and expected_of(episode)["columns"] == remaining
    with pytest.raises(UnreadableRecording, match=rf"{both.stem}\.rrd was cut.* {both.stem}\.h5 was cut"):
        read_episode(both)


@pytest.mark.slow
def test_golden_recordings_are_rescored_as_recorded(
    place: Path, expected: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The recordings are foreign, so their code runs only with --trust."""
    table = tmp_path / "table.json"
    code, _, err = run(capsys, "rescore", place, "--json-file", table)
    assert code == Exit.NOT_TRUSTED and "push.py" in err and not table.exists()
    # One recording is damaged.
    assert run(capsys, "rescore", place, "--json-file", table, "--trust")[0] == Exit.FAILED
    rows = {row["episode"]: row for row in json.loads(table.read_text())}
    everything = {name: (kind, facts) for kind in KINDS for name, facts in expected[kind].items()}
    assert rows.keys() == everything.keys()
    for name, row in rows.items():
        kind, facts = everything[name]
        if why := row["not_judged"]:
            assert kind == "damaged" and f"{name}.h5" in why and f"{name}.rrd" in why
            continue
        # On another CPU, PhysX rounds differently, by up to a micrometre over these steps.
        assert row["largest_reward_change"] < 1e-4
        assert row["other_entries"] in ("", "pushed") and not row["first_state_put_in"]
        assert row["success_now"] == row["success_before"] == (None if kind == "recovered" else 8)
        assert row["return_now"] == pytest.approx(sum(facts["reward"]), rel=1e-5)
        assert bool(row["not_carried"]) is (kind == "damaged")
        drift = row["drift_metres"]
        assert drift is None if name in not_cut(place) else drift < TOLERANCE_METRES
    assert sum(bool(row["not_judged"]) for row in rows.values()) == 1


def test_golden_recordings_can_be_rescored_with_their_recorded_source(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The task on disk differs from the recorded one: its reward is halved."""
    shutil.copytree(place.parent, tmp_path, dirs_exist_ok=True)
    file = tmp_path / "tasks" / "several" / "judging.py"
    text = file.read_text()
    assert "clamp(-1, 1)" in text
    file.write_text(text.replace("clamp(-1, 1)", "clamp(-1, 1) / 2"))
    table = tmp_path / "table.json"
    command = ("rescore", tmp_path / place.name / "several", "--json-file", table, "--trust")
    for arguments, halved in (((), True), (("--recorded-source",), False)):
        assert run(capsys, *command, *arguments)[0] == Exit.DONE
        (row,) = json.loads(table.read_text())
        assert row["differs"] is halved and not row["not_judged"]
        assert row["return_now"] == pytest.approx(row["return_before"] / (2 if halved else 1), rel=1e-5)


def test_the_next_recording_in_a_folder_recovers_an_unfinished_one(
    place: Path, expected: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(place / "unfinished", tmp_path / "unfinished"))
    task = place.parent / "tasks" / "push" / "push.py"
    command = ["record", task, "--out", folder, "--no-pictures", "--episodes", 1, "--num-envs", 1]
    code, _, err = run(capsys, *command, "--max-steps", 2, "--env", "render_backend=none")
    assert code == Exit.DONE and "recovered 1 episode that an earlier recording left unfinished" in err
    assert not (folder / ".writing").exists()
    ((_, recovered),) = expected["recovered"].items()
    found = [facts for facts in read_folder(folder).values() if facts["recovered"]]
    assert_as_expected({"recovered": found[0]}, {"recovered": recovered})
    assert len(found) == 1 and len(list(folder.glob("*.json"))) == 2


# --- continuing live --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def live(place: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with opened(place.parent / "tasks" / "push" / "push.py", tmp_path_factory) as session:
        yield session


@contextmanager
def opened(task: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with live_session(task, tmp_path_factory.mktemp("recordings")) as session:
        session.change(selected_env=1)
        session.change(action_source="sliders")
        # The recorded episodes end with success; without this, the next episode could start after their last step.
        session.change(episode_end="continue")
        yield session


def assert_continues_as_recorded(session: Session, path: Path, state: int) -> None:
    """Continue from the recorded `state` in env 1 to the episode's end with the recorded actions, and compare."""
    episode = read_episode(path)
    entered = session.enter_recording(run_of(episode, state))
    view = wait_until(session, lambda v: v.timeline.entered == entered, "the state")
    assert view.timeline.not_carried == () and view.step.elapsed_steps[1] == state
    # The state must be reached by replaying the actions; restoring the recorded state would prove nothing.
    assert "its actions were replayed" in view.timeline.arrived or state == 0
    assert "put" not in view.timeline.arrived
    assert_close(view.step.poses[1], episode.poses[state])
    for t in range(state, episode.length):
        last = view.timeline.last
        action = tuple(float(x) for x in episode.action[t])
        session.dispatch(SlidersMoved(tuple(range(len(action))), action))
        session.do(Step())
        view = wait_until(session, lambda v, last=last: v.timeline.last > last, "a step")
        assert_close(view.step.poses[1], episode.poses[t + 1])
        assert view.step.reward[1] == pytest.approx(episode.reward[t], abs=TOLERANCE_METRES / 0.02)
        assert bool(view.step.evaluate["success"][1]) == bool(episode.evaluate["success"][t + 1])


def assert_close(poses: np.ndarray, recorded: np.ndarray) -> None:
    np.testing.assert_allclose(poses[:, :3], recorded[:, :3], atol=TOLERANCE_METRES)
    np.testing.assert_allclose(np.abs((poses[:, 3:] * recorded[:, 3:]).sum(1)), 1, atol=TOLERANCE_METRES)


@pytest.mark.parametrize(
    ("kind", "state"),
    [
        *(pytest.param("cameras", state, marks=pytest.mark.slow) for state in (0, 5)),
        ("tagged", 3),
        ("recovered", 4),
    ],
)
def test_a_golden_recording_continues_live(live: Session, place: Path, kind: str, state: int) -> None:
    (path,) = (place / kind).glob("*.json")
    assert_continues_as_recorded(live, path, state)


def test_a_golden_recording_continues_live_in_a_task_of_several_modules(
    place: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    (path,) = (place / "several").glob("*.json")
    with opened(place.parent / "tasks" / "several" / "task.py", tmp_path_factory) as session:
        assert_continues_as_recorded(session, path, 4)
