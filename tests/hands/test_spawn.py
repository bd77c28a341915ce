"""The spawn range of a body is measured, dragged, written into the author's file, checked and reverted in a session."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.drive.session import TASKS, live_session, runs, start_over, wait_until
from workbench.app.session import Session
from workbench.hands.commands import HideSpawn, RevertStartChange, SaveStartChange, SetSpawnSide, WriteSpawn
from workbench.hands.spawn import SpawnAsked, SpawnBox, SpawnDragged
from workbench.hands.start_edit import StartEdit
from workbench.page.command import Refused

TEXT = (TASKS / "push_cube.py").read_text()
ENVS = 3


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("task") / "push_cube.py"
    file.write_text(TEXT)
    return file


@pytest.fixture(scope="module")
def session(child_process: None, file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with live_session(file, tmp_path_factory.mktemp("recordings"), num_envs=ENVS) as session:
        yield session


def measured(session: Session) -> SpawnBox:
    return wait_until(session, lambda v: v.of(SpawnBox).stage == "measured", "the range").of(SpawnBox)


def edit(session: Session, *stages: str) -> StartEdit:
    return wait_until(session, lambda v: v.of(StartEdit).stage in stages, " or ".join(stages)).of(StartEdit)


def test_a_range_is_measured_dragged_saved_checked_and_reverted(session: Session, file: Path) -> None:
    with pytest.raises(Refused):
        session.do(WriteSpawn())
    session.happen(SpawnAsked("cube"))
    box = measured(session)
    (low, high), y = box.measured  # type: ignore[misc]
    session.happen(SpawnDragged("x_min", low - 0.15))
    session.do(SetSpawnSide("x_max", high + 0.1))
    session.do(WriteSpawn())
    planned = edit(session, "planned", "refused")
    assert planned.stage == "planned", planned.message
    assert file.read_text() == TEXT, "nothing is written yet"
    session.do(SaveStartChange())
    done = edit(session, "checked", "mismatch", "refused")
    assert done.stage == "checked", done.message
    new = wait_until(session, lambda v: v.of(SpawnBox).measured != box.measured, "the new range").of(SpawnBox)
    np.testing.assert_allclose(new.measured, ((low - 0.15, high + 0.1), y), atol=2e-4)  # type: ignore[arg-type]
    names = session.view().task.geometry.body_names
    x = np.concatenate([start_over(session, seed).step.poses[:, names.index("cube"), 0] for seed in range(9)])
    assert low - 0.15 <= x.min() < low, "some of 27 episodes begin in the new part"
    session.do(RevertStartChange())
    wait_until(
        session, lambda v: v.of(StartEdit).stage == "undone" and not v.of(StartEdit).writing, "the old text"
    )
    assert file.read_text() == TEXT


def test_sides_do_not_pass_each_other_and_numbers_that_are_no_side_are_refused(session: Session) -> None:
    session.happen(SpawnAsked("cube"))
    (low, high), _ = measured(session).measured  # type: ignore[misc]
    session.happen(SpawnDragged("x_min", high + 1))
    (left, right), _ = session.view().of(SpawnBox).sides
    assert left < right == high
    for number in (float("nan"), float("inf"), 1e5):
        with pytest.raises(Refused):
            session.happen(SpawnDragged("x_max", number))
    session.do(HideSpawn())
    assert session.view().of(SpawnBox).stage == "none"
    with pytest.raises(Refused):
        session.happen(SpawnDragged("x_min", low))


def test_a_fixed_body_has_no_range_and_an_unknown_one_is_refused(session: Session) -> None:
    session.happen(SpawnAsked("table-workspace"))
    assert measured(session).measured == (None, None)
    with pytest.raises(Refused):
        session.do(SetSpawnSide("x_min", 0.0))
    with pytest.raises(Refused):
        session.happen(SpawnAsked("no such body"))


def test_a_version_without_the_body_closes_the_range(session: Session, file: Path) -> None:
    session.happen(SpawnAsked("cube"))
    measured(session)
    text = TEXT.replace('name="cube"', 'name="block"')
    assert text != TEXT
    file.write_text(text)
    runs(session, text)
    assert session.view().of(SpawnBox).stage == "none"
