"""What a task draws with `workbench.draw`: kept with each moment, shown in the view, and nothing without a workbench."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import workbench
from tests.drive.envs import CPU
from tests.drive.panels import Panels
from tests.drive.session import live_session, moment_at, save, start_over, step, wait_until
from workbench import draw
from workbench.envs.task_drawings import Drawing, TaskDrawings, drawings
from workbench.episodes.reader.read_episode import read_episode
from workbench.page.scene.task_drawings import TaskDrawingsView
from workbench.planning.options import PlanOptions
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions
from workbench.task.description import TaskOptions

TASK = """
import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.utils.registration import register_env
from workbench import draw


@register_env("Draws-v1", max_episode_steps=50, override=True)
class Draws(PushCubeEnv):
    def _initialize_episode(self, env_idx, options):
        super()._initialize_episode(env_idx, options)
        draw.frames("spawn", self.obj.pose.raw_pose[env_idx], env_idx=env_idx)

    def evaluate(self):
        draw.points("cube", self.obj.pose.p)
        ends = torch.stack([self.obj.pose.p, self.goal_region.pose.p], dim=1)
        draw.arrows("to goal", ends, color="#ff0000")
        draw.text("height", self.obj.pose.p, [f"{z:.2f}" for z in self.obj.pose.p[:, 2].tolist()])
        return super().evaluate()
"""


@pytest.fixture
def on(monkeypatch: pytest.MonkeyPatch) -> Iterator[TaskDrawings]:
    """The drawings of this process, switched on and empty."""
    monkeypatch.setattr(drawings, "on", True)
    yield drawings
    for name in [*drawings.of_batch(3)]:
        drawings.remove(name)


def test_each_moment_keeps_what_was_drawn_then(child_process: None, tmp_path: Path) -> None:
    file = tmp_path / "task.py"
    file.write_text(TASK)
    with live_session(file, tmp_path / "recordings", num_envs=3) as session:
        start = start_over(session, 5)
        cube = start.task.geometry.body_names.index("cube")
        later = step(session, 3)
        for view in (start, later):
            drawn = view.step.drawn
            assert drawn.keys() == {"spawn", "cube", "to goal", "height"}
            np.testing.assert_allclose(drawn["cube"].data[:, 0], view.step.poses[:, cube, :3], atol=1e-6)
            assert drawn["to goal"].data.shape == (3, 1, 2, 3) and drawn["to goal"].color == (255, 0, 0)
            assert drawn["height"].texts == ("0.02",) * 3
            np.testing.assert_allclose(
                drawn["spawn"].data[:, 0, :3], start.step.poses[:, cube, :3], atol=1e-6
            )
        kept = moment_at(session, start.timeline.last)
        assert (
            kept is not None
            and kept.step.drawn["cube"].data.tobytes() == start.step.drawn["cube"].data.tobytes()
        )
        view = save(session, file, TASK.replace('draw.points("cube"', 'draw.points("the cube"'))
        assert "the cube" in view.step.drawn
        wrong = TASK.replace(
            'draw.points("cube", self.obj.pose.p)', 'draw.points("cube", self.obj.pose.p[:, :2])'
        )
        file.write_text(wrong)
        view = wait_until(session, lambda v: v.problem is not None, "the problem")
        assert view.problem.line == wrong[: wrong.index('draw.points("cube"')].count("\n") + 1


@pytest.mark.parametrize("actions", ["random", "solve"])
def test_a_recording_from_the_terminal_has_its_own_envs_drawings(
    child_process: None, tmp_path: Path, actions: str
) -> None:
    """The envs of a plan's rollouts draw too, and are no part of the recording."""
    beyond = (
        'if (self.elapsed_steps > 3).any():\n            draw.points("beyond", self.obj.pose.p)\n        '
    )
    (tmp_path / "task.py").write_text(TASK.replace("return super().eval", f"{beyond}return super().eval"))
    options = TaskOptions(num_envs=4, env_kwargs={"render_backend": "none"})
    plan = PlanOptions(rollouts=4, horizon=0.1)
    done = record(
        RecordOptions(
            str(tmp_path / "task.py"), tmp_path, 2, actions=actions, max_steps=3, options=options, plan=plan
        )
    )
    for written in done.written:
        episode = read_episode(written.path)
        assert episode.geometry is not None and episode.poses is not None
        cube = episode.poses[:, episode.geometry.body_names.index("cube"), :3]
        for state in range(4):
            drawn = episode.drawings_at(state)
            assert drawn.keys() == {"spawn", "cube", "to goal", "height"}
            np.testing.assert_allclose(drawn["cube"].data[0], cube[state : state + 1], atol=1e-6)
            np.testing.assert_allclose(drawn["spawn"].data[0, :, :3], cube[:1], atol=1e-6)
    assert len(done.written) == 2 and not drawings.on


def test_a_recorder_takes_the_drawings_of_its_own_env(tmp_path: Path) -> None:
    (tmp_path / "task.py").write_text(TASK)
    env = workbench.Recorder(workbench.make(str(tmp_path / "task.py"), 2, **CPU), tmp_path / "out")
    other = workbench.make(str(tmp_path / "task.py"), 2, **CPU)
    env.reset(seed=1)
    for _ in range(2):
        other.reset(seed=3)
        env.step(env.action_space.sample())
    env.close()
    other.close()
    paths = sorted((tmp_path / "out").glob("*.json"))
    for episode in map(read_episode, paths):
        assert episode.geometry is not None and episode.poses is not None
        start = episode.poses[0, episode.geometry.body_names.index("cube"), :3]
        np.testing.assert_allclose(episode.drawings_at(2)["spawn"].data[0, 0, :3], start, atol=1e-6)
    assert len(paths) == 2


@given(st.lists(st.tuples(st.booleans(), st.sets(st.integers(0, 4)), st.integers(1, 3)), max_size=8))
def test_the_newest_drawing_of_each_env_is_kept(puts: list[tuple[bool, set[int], int]]) -> None:
    """Points are drawn in all five envs or in some, each time with other numbers."""
    kept, wanted = TaskDrawings(), dict[int, np.ndarray]()
    for number, (every, some, count) in enumerate(puts):
        envs = list(range(5)) if every else sorted(some)
        data = np.full((len(envs), count, 3), number, np.float32)
        kept.put("it", Drawing("points", data), None if every else envs)
        wanted |= dict.fromkeys(envs, np.full((count, 3), number, np.float32))
    drawn = kept.of_batch(5).get("it")
    for env in range(5):
        rows = np.zeros((0, 3)) if drawn is None else drawn.data[env]
        rows = rows[np.isfinite(rows).all(axis=1)]
        np.testing.assert_array_equal(rows, wanted.get(env, np.zeros((0, 3))))


def test_each_kind_is_kept_with_its_own_numbers_for_each_env(on: TaskDrawings) -> None:
    """Three envs that all differ; then two of them again, in another order."""
    rows = torch.arange(3.0)
    position = torch.stack([rows, rows + 10, rows + 20], dim=1)
    pair = torch.stack([position, position + 100], dim=1)
    pose = torch.cat([position, torch.tensor([[0.0, 1, 0, 0]] * 3)], dim=1)
    draw.points("dots", torch.stack([position, position + 1], dim=1), "#0102ff", size=0.5)
    draw.lines("line", pair, color="#030405")
    draw.arrows("arrow", pair[:, None], size=0.25)
    draw.frames("frame", type("Pose", (), {"raw_pose": pose})(), size=0.75)
    draw.text("words", position, ["a", "b", "c"])
    draw.text("same", position.tolist(), "all")
    drawn = on.of_batch(3)
    assert {name: (one.kind, one.color, one.size) for name, one in drawn.items()} == {
        "dots": ("points", (1, 2, 255), 0.5),
        "line": ("lines", (3, 4, 5), 0.0),
        "arrow": ("arrows", (255, 146, 43), 0.25),
        "frame": ("frames", (255, 146, 43), 0.75),
        "words": ("text", (255, 146, 43), 0.0),
        "same": ("text", (255, 146, 43), 0.0),
    }
    for name, rows in (("line", pair), ("arrow", pair), ("frame", pose), ("words", position)):
        np.testing.assert_array_equal(drawn[name].data[:, 0], rows.numpy())
    np.testing.assert_array_equal(drawn["dots"].data[:, 1], position.numpy() + 1)
    assert drawn["words"].texts == ("a", "b", "c") and drawn["same"].texts == ("all",) * 3
    some = torch.tensor([2, 0])
    draw.points("dots", position[some] + 50, env_idx=some)
    draw.text("words", position[some], ["C", "A"], env_idx=[2, 0])
    draw.remove("same")
    draw.remove("never drawn")
    drawn = on.of_batch(3)
    np.testing.assert_array_equal(drawn["dots"].data[[0, 2], 0], position.numpy()[[0, 2]] + 50)
    np.testing.assert_array_equal(drawn["dots"].data[1, :, 0], [1, 2])
    assert drawn["words"].texts == ("A", "b", "C") and "same" not in drawn
    position += 1  # the drawing is a copy
    assert drawn["words"].data[1, 0, 0] == 1


def test_without_a_workbench_nothing_is_looked_at() -> None:
    assert not drawings.on
    draw.points("it", object())
    draw.frames("it", None)
    assert not drawings.of_batch(1)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: draw.points("it", np.zeros((3, 2))), "(3, 2)"),
        (lambda: draw.lines("it", np.zeros((3, 3))), "(3, 3)"),
        (lambda: draw.points("it", np.zeros((3, 3)), env_idx=[0]), "3 rows"),
        (lambda: draw.text("it", np.zeros((3, 3)), ["a"]), "1 texts"),
        (lambda: draw.points("it", np.zeros((1, 9999, 3))), "9999"),
    ],
)
def test_a_wrong_shape_is_refused(on: TaskDrawings, call: Any, words: str) -> None:
    with pytest.raises(ValueError, match=r"draw\.") as refused:
        call()
    assert words in str(refused.value) and not on.of_batch(3)


def test_the_selected_envs_drawings_are_in_the_view(panels: Panels, on: TaskDrawings) -> None:
    shown, offset = TaskDrawingsView(panels.server), np.array([1.0, 0.0, 0.0])
    position = torch.tensor([[0.0, 0, 0], [0, 0, 1], [0, 0, 2]])
    draw.points("dot", position)
    draw.lines("line", torch.stack([position, position + 1], dim=1))
    draw.arrows("arrow", torch.stack([position, position + 1], dim=1))
    draw.frames("frame", torch.cat([position, torch.tensor([[1.0, 0, 0, 0]] * 3)], dim=1))
    draw.text("words", position, ["a", "b", "c"])

    def names() -> set[str]:
        return {node.name.removeprefix("/drawn/") for node in panels.nodes("/drawn/")}

    for env in (1, 2):
        shown.draw(on.of_batch(3), env, offset)
        assert names() == {"dot", "line", "arrow", "frame", "words"}
        (dot,) = panels.nodes("/drawn/dot")
        np.testing.assert_allclose(dot.points, [[1, 0, env]], atol=1e-6)
        assert "abc"[env] in panels.labels()
    draw.remove("arrow")
    draw.points("dot", position, color="#00ff00")
    shown.draw(on.of_batch(3), 2, offset)
    assert names() == {"dot", "line", "frame", "words"}
    (dot,) = panels.nodes("/drawn/dot")
    assert np.asarray(dot.colors).reshape(-1, 3).tolist()[0] == [0, 255, 0]
    shown.draw({}, 2, offset)
    assert not names()
    shown.draw(on.of_batch(3), 2, offset)
    assert names() == {"dot", "line", "frame", "words"}, "it was drawn as before, but is no longer there"
