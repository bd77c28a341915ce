"""The spawn range of a body is measured, dragged, written into the author's file, checked and reverted in a session."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.drive.hands import edit_reaches, revert_edit, save_planned_edit
from tests.drive.session import TASKS, live_session, runs, start_over, wait_until
from workbench.app.session import Session
from workbench.hands.commands import SetSpawnSide, WriteSpawn
from workbench.hands.spawn import SpawnAsked, SpawnBox, SpawnDragged
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


def test_a_range_is_measured_dragged_saved_checked_and_reverted(session: Session, file: Path) -> None:
    with pytest.raises(Refused):
        session.do(WriteSpawn())
    session.dispatch(SpawnAsked("cube"))
    box = measured(session)
    (low, high), y = box.measured  # type: ignore[misc]
    session.dispatch(SpawnDragged("x_min", low - 0.15))
    session.do(SetSpawnSide("x_max", high + 0.1))
    session.do(WriteSpawn())
    edit_reaches(session, "planned", "refused")
    assert file.read_text() == TEXT, "nothing is written yet"
    save_planned_edit(session)
    new = wait_until(session, lambda v: v.of(SpawnBox).measured != box.measured, "the new range").of(SpawnBox)
    np.testing.assert_allclose(new.measured, ((low - 0.15, high + 0.1), y), atol=2e-4)  # type: ignore[arg-type]
    names = session.view().task.geometry.body_names
    x = np.concatenate([start_over(session, seed).step.poses[:, names.index("cube"), 0] for seed in range(9)])
    assert low - 0.15 <= x.min() < low, "some of 27 episodes begin in the new part"
    revert_edit(session)
    assert file.read_text() == TEXT


def test_a_version_without_the_body_closes_the_range(session: Session, file: Path) -> None:
    session.dispatch(SpawnAsked("cube"))
    measured(session)
    text = TEXT.replace('name="cube"', 'name="block"')
    assert text != TEXT
    file.write_text(text)
    runs(session, text)
    assert session.view().of(SpawnBox).stage == "none"
