"""The robot's joint positions are written into the author's file: planned, run, saved, checked and reverted in a session."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.drive.hands import edit_reaches, revert_edit, save_planned_edit
from tests.drive.session import TASKS, jump, live_session, runs
from workbench.app.session import Session
from workbench.hands.commands import SetJoint, WriteQpos
from workbench.hands.qpos_source import find_qpos, plan_qpos, without_noise
from workbench.page.command import Refused
from workbench.source.parsed import RefusedEdit

ROBOT = "workbench_pen_arm"
FILE = "/tasks/reach.py"
REST = np.array([[0.0, 1.2, 0.0], [0.05, 1.25, 0.0]])


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("task")
    for name in ("own_robot.py", "own_robot.urdf"):
        shutil.copy(TASKS / name, folder)
    return folder / "own_robot.py"


@pytest.fixture(scope="module")
def session(child_process: None, file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with live_session(file, tmp_path_factory.mktemp("recordings")) as session:
        yield session


def test_a_keyframe_to_which_a_reset_adds_noise_is_written_checked_and_reverted(
    session: Session, file: Path
) -> None:
    text = file.read_text()
    with pytest.raises(Refused):
        session.do(WriteQpos("no such robot"))
    jump(session, lambda: session.do(SetJoint(ROBOT, 0, 28.6478898)))
    jump(session, lambda: session.do(SetJoint(ROBOT, 1, 45.8366236)))
    session.do(WriteQpos(ROBOT))
    edit_reaches(session, "planned", "refused")
    assert file.read_text() == text, "nothing is written yet"
    save_planned_edit(session)
    assert file.read_text() == text.replace("np.array([0.0, 1.2, 0.0])", "np.array([0.5, 0.8, 0.0])")
    revert_edit(session)
    assert file.read_text() == text


def test_noise_that_the_seed_does_not_decide_is_noted(session: Session, file: Path) -> None:
    text = file.read_text()
    unseeded = text.replace("torch.rand((b, 3)) *", "torch.as_tensor(np.random.rand(b, 3)).float() *")
    file.write_text(unseeded)
    runs(session, unseeded)
    jump(session, lambda: session.do(SetJoint(ROBOT, 0, 28.6478898)))
    session.do(WriteQpos(ROBOT))
    planned = edit_reaches(session, "planned", "refused")
    assert planned.edit is not None, planned.message
    assert any(ROBOT in note for note in planned.edit.notes)
    file.write_text(text)


def test_only_the_positions_that_change_are_replaced() -> None:
    text = "qpos = np.array([0.0, np.pi * 3 / 8, 0])\nother = [5, 6, 7]\n"
    written = find_qpos({FILE: text}, REST)
    assert plan_qpos(written, (0.25, np.pi * 3 / 8, 0.0)).new_text == text.replace("[0.0", "[0.25")
    with pytest.raises(RefusedEdit):
        plan_qpos(written, (0.00001, np.pi * 3 / 8, 0.0))


def test_noise_of_the_present_episode_is_not_written() -> None:
    text = "qpos = [0.0, 1.2, 0.0]\n"
    written = find_qpos({FILE: text}, REST)
    to = without_noise(written, REST, (0.5, 1.23, 0.0))
    assert plan_qpos(written, to).new_text == "qpos = [0.5, 1.2, 0.0]\n"


REFUSED = {
    "no list": ("qpos = start()\n", "no list"),
    "a list elsewhere": ("qpos = [0.0, 0.6, 0.0]\n", "no list"),
    "a list with a name in it": ("qpos = [0.0, ELBOW, 0.0]\n", "no list"),
    "two lists": ("qpos = [0.0, 1.2, 0.0]\ngoal_qpos = [0.0, 1.2, 0]\n", "several lists"),
}


@pytest.mark.parametrize(("text", "why"), REFUSED.values(), ids=REFUSED)
def test_what_is_not_one_list_is_refused(text: str, why: str) -> None:
    with pytest.raises(RefusedEdit, match=why):
        find_qpos({FILE: text}, REST)


def test_a_list_named_qpos_is_preferred() -> None:
    text = "p = [0.0, 1.2, 0.0]\nkeyframe = Keyframe(qpos=np.array([0.0, 1.2, 0]))\n"
    assert plan_qpos(find_qpos({FILE: text}, REST), (0, 1, 0)).new_text == text.replace("1.2, 0]", "1.0, 0]")


def test_a_file_of_an_installed_package_is_refused() -> None:
    path = "/venv/lib/python3.11/site-packages/mani_skill/agents/arm.py"
    with pytest.raises(RefusedEdit, match="installed package"):
        find_qpos({path: "qpos = [0.0, 1.2, 0.0]\n"}, REST)
