"""A recording's task: which class of which file is opened, with which options, up to which state, from which text."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import mani_skill
import numpy as np
import pytest

from tests.drive.episodes import made
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.recorded_source import (
    CannotEnterRecording,
    class_in,
    options_of,
    recorded_source,
    recorded_version,
    reference_of,
    run_of,
)
from workbench.task.description import TaskOptions

TWO = """
from mani_skill.utils.registration import register_env

@register_env("A-v1", max_episode_steps=9)
class One: ...

@register_env("B-v1")
class Two: ...

class Plain: ...
"""


def info_of(**info: Any) -> EpisodeInfo:
    return made(1, **info).info


@pytest.mark.parametrize("state", [None, 0, 2, 4])
def test_a_run_ends_at_its_state(state: int | None) -> None:
    states = np.arange(5 * 13, dtype=np.float32).reshape(5, 13)
    episode = replace(made(4, seed=0, reset_options={"level": 2}), env_states={"actors/cube": states})
    run, steps = run_of(episode, state), 4 if state is None else state
    assert (run.length, run.seed, run.reset_options, run.name) == (steps, 0, {"level": 2}, "Push-v1, seed 0")
    assert run.reward.tolist() == list(range(1, steps + 1))
    np.testing.assert_array_equal(run.env_states["actors/cube"], states[: steps + 1])
    np.testing.assert_array_equal(run.evaluate["distance"], episode.evaluate["distance"][: steps + 1])


def test_a_run_has_no_state_beyond_its_episode_and_no_reward_that_the_task_lacks() -> None:
    for state in (-1, 5):
        with pytest.raises(CannotEnterRecording):
            run_of(made(4), state)
    assert run_of(made(4, env_kwargs={"reward_mode": "none"})).reward.size == 0
    assert run_of(made(4, seed=-1)).name == "Push-v1"


def test_todays_code_is_the_class_with_the_recorded_id_else_the_id(tmp_path: Path) -> None:
    file = tmp_path / "tasks.py"
    file.write_text(TWO)
    for env_id, name in (("A-v1", "One"), ("B-v1", "Two"), ("Plain", "Plain")):
        assert class_in(file, env_id) == f"{file}:{name}"
        assert str(reference_of(info_of(task=env_id, source_file=str(file)))) == f"{file}:{name}"
    assert class_in(file, "C-v1") is None and class_in(tmp_path / "none.py", "A-v1") is None
    installed = Path(mani_skill.__file__).parent / "envs" / "tasks" / "tabletop" / "pick_cube.py"
    assert class_in(installed, "PickCube-v1") is not None
    others = ("tasks.py", str(file.with_suffix(".txt")), str(tmp_path), str(tmp_path / "gone.py"), None)
    for task, other in (*(("A-v1", other) for other in others), ("PickCube-v1", str(installed))):
        assert str(reference_of(info_of(task=task, source_file=other))) == task
    file.write_text("def (")
    assert class_in(file, "A-v1") is None


def test_the_env_is_made_with_the_recorded_options_except_those_of_batch_and_rendering() -> None:
    left_out: dict[str, Any] = {"num_envs": 64, "sim_backend": "gpu", "human_render_camera_configs": {}}
    left_out |= {"render_device": "cuda:1", "render_mode": "human", "render_backend": "gpu"}
    kept = {"robot_uids": "panda_wristcam", "obs_mode": "rgb"}
    recorded = info_of(pictures="fast", seed=6, env_kwargs=left_out | kept)
    options = options_of(recorded, 3, TaskOptions(rules="warn"))
    assert (options.num_envs, options.seed, options.pictures, options.rules) == (3, 6, "fast", "warn")
    assert options.env_kwargs == {**kept, "control_mode": "pd_joint_delta_pos"}
    named = options_of(info_of(seed=-1, env_kwargs={"control_mode": "pd_ee_pose"}), 1)
    assert (named.seed, named.env_kwargs, named.pictures) == (0, {"control_mode": "pd_ee_pose"}, "exact")
    # As older versions recorded the modes of several robots.
    assert options_of(info_of(control_mode="{'panda-0': 'pd_ee_pose'}"), 1).env_kwargs == {}


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of temporary folders."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.mark.parametrize("main", ["push.py", "/there/push.py"])
def test_the_recorded_text_is_opened_in_a_folder_that_is_removed(temporary: Path, main: str) -> None:
    texts = {"lib/push.py": "x = 1\n", "push.py": TWO, "shapes.py": "SIZE = 1\n"}
    recorded = {str(Path(main).parent / name): text for name, text in texts.items()}
    recorded[str(Path(main).parent / "../../outside.py")] = "y = 1\n"
    info = info_of(task="B-v1", source_file=main, source=recorded)
    with recorded_source(info) as reference:
        (folder,) = temporary.iterdir()
        assert reference == f"{folder / 'push.py'}:Two"
        found = {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*.py")}
    assert found == {**texts, "outside.py": "y = 1\n"}
    assert list(temporary.iterdir()) == []
    version = recorded_version(info)
    assert version and version == recorded_version(replace(info, source=dict(reversed(recorded.items()))))
    assert version != recorded_version(replace(info, source={**recorded, main: TWO + "# edited\n"}))
    assert recorded_version(replace(info, source={})) == ""


def test_no_folder_is_left_of_a_text_that_cannot_be_written(temporary: Path) -> None:
    for source in ({"push.py": TWO, "a\0b.py": ""}, {"other.py": TWO}, {}):
        with (
            pytest.raises(CannotEnterRecording),
            recorded_source(info_of(source_file="push.py", source=source)),
        ):
            pass
    assert list(temporary.iterdir()) == []


def test_only_todays_data_files_within_the_tasks_folder_are_placed_beside_the_recorded_text(
    tmp_path: Path, temporary: Path
) -> None:
    """A Python module or library of that name would run without having been shown to the user."""
    author = tmp_path / "author"
    (author / "meshes").mkdir(parents=True)
    code = ("numpy.py", "lib.so", "json.cpython-311-x86_64-linux-gnu.so")
    for name in ("push.py", "meshes/part.obj", "table.csv", "../secret", *code):
        (author / name).write_text(TWO if name == "push.py" else "today's")
    above = ("../secret", "meshes/../../secret", str(tmp_path / "secret"))
    names = ("meshes/part.obj", "table.csv", "meshes/deleted.obj", *above, *code)
    source = {str(author / "push.py"): TWO}
    info = info_of(
        source_file=str(author / "push.py"), source=source, side_files=dict.fromkeys(names, "0" * 12)
    )
    with recorded_source(info):
        (folder,) = temporary.iterdir()
        found = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
        assert found == {"push.py", "table.csv", "meshes", "meshes/part.obj"}
        assert (folder / "meshes" / "part.obj").read_text() == "today's"
    assert (author / "meshes" / "part.obj").read_text() == "today's"
