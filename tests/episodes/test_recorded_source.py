"""A recording's task: which class of which file is opened, with which options, up to which state, from which text."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.drive.episodes import made
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.recorded_source import (
    CannotEnterRecording,
    class_in,
    options_of,
    recorded_version,
    reference_of,
    run_of,
    write_source,
)

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


def test_the_class_is_the_one_with_the_recorded_id(tmp_path: Path) -> None:
    file = tmp_path / "tasks.py"
    file.write_text(TWO)
    for env_id, name in (("A-v1", "One"), ("B-v1", "Two"), ("Plain", "Plain")):
        assert class_in(file, env_id) == f"{file}:{name}"
        assert str(reference_of(info_of(task=env_id, source_file=str(file)))) == f"{file}:{name}"
    assert class_in(file, "C-v1") is None and class_in(tmp_path / "none.py", "A-v1") is None
    for other in ("tasks.py", str(file.with_suffix(".txt")), str(tmp_path)):
        assert str(reference_of(info_of(task="A-v1", source_file=other))) == "A-v1"
    file.write_text("def (")
    assert class_in(file, "A-v1") is None


def test_options_are_those_of_the_recording() -> None:
    options = options_of(info_of(pictures="fast", seed=6, env_kwargs={"human_render_camera_configs": {}}), 3)
    assert (options.num_envs, options.seed, options.pictures) == (3, 6, "fast")
    assert options.env_kwargs == {"control_mode": "pd_joint_delta_pos"}
    named = options_of(info_of(seed=-1, env_kwargs={"control_mode": "pd_ee_pose"}), 1)
    assert (named.seed, named.env_kwargs, named.pictures) == (0, {"control_mode": "pd_ee_pose"}, "exact")
    # As older versions recorded the modes of several robots.
    assert options_of(info_of(control_mode="{'panda-0': 'pd_ee_pose'}"), 1).env_kwargs == {}


@pytest.mark.parametrize("main", ["push.py", "/there/push.py"])
def test_the_recorded_text_keeps_its_folders_and_its_own_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, main: str
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    texts = {"lib/push.py": "x = 1\n", "push.py": TWO, "shapes.py": "SIZE = 1\n"}
    recorded = {str(Path(main).parent / name): text for name, text in texts.items()}
    info = info_of(task="B-v1", source_file=main, source=recorded)
    folder, reference = write_source(info)
    assert reference == f"{folder / 'push.py'}:Two"
    found = {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*.py")}
    assert found == texts
    shutil.rmtree(folder)
    version = recorded_version(info)
    assert version and version == recorded_version(replace(info, source=dict(reversed(recorded.items()))))
    assert version != recorded_version(replace(info, source={**recorded, main: TWO + "# edited\n"}))
    assert recorded_version(replace(info, source={})) == ""


def test_no_folder_is_left_of_a_text_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for source in ({"push.py": TWO, "a\0b.py": ""}, {"other.py": TWO}, {}):
        with pytest.raises(CannotEnterRecording):
            write_source(info_of(source_file="push.py", source=source))
    assert list(tmp_path.iterdir()) == []


def test_a_module_beside_the_task_that_was_not_recorded_is_not_linked(tmp_path: Path) -> None:
    file = tmp_path / "push.py"
    file.write_text(TWO)
    for name in ("hidden.py", "lib.so", "table.csv"):
        (tmp_path / name).write_text("")
    names = dict.fromkeys(("hidden.py", "lib.so", "table.csv"), "0" * 12)
    folder, _ = write_source(info_of(source_file=str(file), source={str(file): TWO}, side_files=names))
    assert sorted(path.name for path in folder.iterdir()) == ["push.py", "table.csv"]
    shutil.rmtree(folder)
