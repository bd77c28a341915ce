"""Where a body was moved is written into the author's file: planned, run, saved, checked and reverted in a session."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import difflib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.drive.hands import edit_reaches, revert_edit, save_planned_edit
from tests.drive.session import TASKS, jump, live_session, runs, save, start_over
from workbench.app.session import Session
from workbench.hands.commands import DropStartChange, SaveStartChange
from workbench.hands.start_edit import BodyPose, StartEdit, StartWanted
from workbench.hands.state import BodyMoved
from workbench.live.commands import PauseRun

THERE = (0.12, -0.2, 0.03, 0.9238795, 0.0, 0.0, 0.3826834)
MINIMAL = (TASKS / "minimal.py").read_text()
RESET_LINES = [
    line + "\n"
    for line in MINIMAL.splitlines()
    if line.strip().startswith(("p = torch", "self.cube.set_pose"))
]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("task") / "minimal.py"
    file.write_text(MINIMAL)
    return file


@pytest.fixture(scope="module")
def session(child_process: None, file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with live_session(file, tmp_path_factory.mktemp("recordings")) as session:
        yield session


@pytest.fixture
def opened(session: Session, file: Path) -> Session:
    """The session with the original file, paused."""
    session.do(DropStartChange())
    session.do(PauseRun())
    if file.read_text() != MINIMAL:
        file.write_text(MINIMAL)
    runs(session, MINIMAL)
    return session


def want(session: Session) -> StartEdit:
    """Move the cube, ask to write its pose, and wait for the plan."""
    jump(session, lambda: session.dispatch(BodyMoved("cube", (0, 1), THERE)))
    session.dispatch(StartWanted(BodyPose("cube", THERE)))
    return edit_reaches(session, "planned", "refused")


def first_poses(session: Session, seed: int) -> np.ndarray:
    """(N, 7) of the cube after a reset."""
    step = start_over(session, seed).step
    return step.poses[:, session.view().task.geometry.body_names.index("cube")]


def changed_lines(old: str, new: str) -> list[str]:
    return [line for line in difflib.ndiff(old.splitlines(), new.splitlines()) if line[0] in "+-"]


def test_a_pose_of_each_reset_is_shown_saved_checked_and_reverted(opened: Session, file: Path) -> None:
    want(opened)
    assert file.read_text() == MINIMAL, "nothing is written yet"
    save_planned_edit(opened)
    assert changed_lines(MINIMAL, file.read_text()) == [
        "-         p = torch.tensor([0, 0, 0.03], device=self.device).repeat(len(env_idx), 1)",
        "+         p = torch.tensor([0.12, -0.2, 0.03], device=self.device).repeat(len(env_idx), 1)",
        "-         self.cube.set_pose(Pose.create_from_pq(p=p))",
        "+         self.cube.set_pose(Pose.create_from_pq(p=p, q=[0.9238795, 0.0, 0.0, 0.3826834]))",
    ]
    np.testing.assert_allclose(first_poses(opened, 7), [THERE, THERE], atol=1e-4)
    revert_edit(opened)
    assert file.read_text() == MINIMAL


def test_a_builders_pose_is_written_where_no_reset_sets_another(opened: Session, file: Path) -> None:
    text = MINIMAL
    for line in RESET_LINES:
        text = text.replace(line, "")
    save(opened, file, text)
    want(opened)
    save_planned_edit(opened)
    assert [line.strip("+- ") for line in changed_lines(text, file.read_text())] == [
        "builder.initial_pose = sapien.Pose(p=[0, 0, 0.03])",
        "builder.initial_pose = sapien.Pose(p=[0.12, -0.2, 0.03], q=[0.9238795, 0.0, 0.0, 0.3826834])",
    ]


def test_a_text_whose_run_does_not_give_the_pose_is_refused(opened: Session, file: Path) -> None:
    moved = (
        "        for body in [self.cube]:\n            body.set_pose(Pose.create_from_pq(p=[FAR, 0, 0.03]))\n"
    )
    text = MINIMAL.replace("p=[0, 0, 0.03])\n", "p=[FAR, 0, 0.03])\n").replace(
        "\n@register_env", "\nFAR = 0.3\n\n\n@register_env", 1
    )
    for line in RESET_LINES:
        text = text.replace(line, moved)
        moved = ""
    save(opened, file, text)
    planned = want(opened)
    assert planned.stage == "refused" and planned.message
    assert "sapien.Pose(p=[0.12, -0.2, 0.03]" in planned.snippet
    assert file.read_text() == text


def test_what_the_seed_does_not_decide_is_not_blamed_on_the_change(opened: Session, file: Path) -> None:
    built = MINIMAL[MINIMAL.index("        builder = ") : MINIMAL.index("    def _initialize_episode")]
    text = MINIMAL.replace(built, built + built.replace("cube", "post") + built.replace("cube", "shadow"))
    text = text.replace("import sapien\n", "import numpy as np\nimport sapien\n")
    text = text.replace(
        RESET_LINES[-1],
        RESET_LINES[-1]
        + "        self.post.set_pose(Pose.create_from_pq(p=[*np.random.uniform(1, 2, 2), 0.03]))\n"
        + "        self.shadow.set_pose(Pose.create_from_pq(p=p + torch.tensor([0.0, 0.0, 1.0])))\n",
    )
    save(opened, file, text)
    planned = want(opened)
    assert planned.edit is not None, planned.message
    named = [{name for name in ("cube", "post", "shadow") if name in note} for note in planned.edit.notes]
    assert named == [{"shadow"}, {"post"}]


def test_an_edit_that_the_author_made_meanwhile_is_not_overwritten(opened: Session, file: Path) -> None:
    assert want(opened).stage == "planned"
    save(opened, file, MINIMAL + "# mine\n")
    opened.do(SaveStartChange())
    done = edit_reaches(opened, "refused")
    assert "edited since" in done.message and file.read_text() == MINIMAL + "# mine\n"
