"""The views in which rerun shows a recording, read from the blueprint in its file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from tests.drive.episodes import Made, Track
from tests.drive.rows import append
from workbench.envs.camera_data import CameraInfo
from workbench.envs.step_result import OtherEntry
from workbench.envs.task_drawings import Drawing

Maker = Callable[..., Made]
TABS, VERTICAL = 1, 3
"""Rerun's numbers of kinds of containers."""


def blueprint_of(path: Path) -> dict[str, dict[str, Any]]:
    """The values in the file's blueprint, by entity and component."""
    reader = RrdReader(path)
    (store,) = reader.blueprints()
    found: dict[str, dict[str, Any]] = {}
    for chunk in reader.stream(store=store):
        batch = chunk.to_record_batch()
        for field, column in zip(batch.schema, batch.columns):
            if (field.metadata or {}).get(b"rerun:kind") == b"data":
                found.setdefault(chunk.entity_path, {})[field.name] = column.to_pylist()[-1]
    return found


def views_of(blueprint: dict[str, dict[str, Any]]) -> dict[str, tuple[str, str, list[str]]]:
    """Kind, origin and content of each view, by its name."""
    return {
        held["ViewBlueprint:display_name"][0]: (
            held["ViewBlueprint:class_identifier"][0],
            held["ViewBlueprint:space_origin"][0],
            blueprint.get(f"{entity}/ViewContents", {}).get("ViewContents:query", []),
        )
        for entity, held in blueprint.items()
        if "ViewBlueprint:display_name" in held
    }


def camera(name: str, *modalities: str) -> Track:
    info = CameraInfo(name, "sensor", 2, 2, 1.0, 0.01, 9.0, np.eye(3, dtype=np.float32), None, modalities)
    pose = np.array([[0, 0, 0, 1, 0, 0, 0]], np.float32)
    held: Any = {
        "rgb": np.zeros((1, 2, 2, 3), np.uint8),
        "depth": np.zeros((1, 2, 2), np.float32),
        "segmentation": np.zeros((1, 2, 2), np.int32),
    }
    return Track(info, np.array([0]), pose, **{m: held[m] for m in modalities})


def test_each_part_of_an_episode_has_its_view(make_episode: Maker, tmp_path: Path) -> None:
    evaluate = {
        "success": np.zeros(4, bool),
        "a/b": np.zeros((4, 32), np.float32),
        "map": np.zeros((4, 33), np.float32),
        "none": np.zeros((4, 0), np.float32),
        "reward_terms/reach": np.zeros(4, np.float32),
    }
    cameras = [camera("eye", "rgb", "depth", "segmentation"), camera("hand", "rgb")]
    episode = make_episode(3, evaluate=evaluate, cameras=cameras)
    episode.drawn = [{"dot": Drawing("points", np.ones((1, 1, 3), np.float32))}] * 4
    writer = episode.writer(tmp_path)
    others = {"mean": OtherEntry("float", numbers=np.array(0.5)), "phase": OtherEntry("str", ("reach",))}
    for row in episode.rows():
        append(writer, replace(row, others=others))
    views = views_of(blueprint_of(writer.finish().rrd))
    hidden = [f"- /world/cameras/{name}/{m}" for name in ("eye", "hand") for m in ("depth", "segmentation")]
    assert views == {
        "Scene": ("3D", "/world", ["$origin/**", "/drawings/**", *hidden]),
        "eye rgb": ("2D", "/world/cameras/eye", ["$origin/rgb"]),
        "eye depth": ("2D", "/world/cameras/eye", ["$origin/depth"]),
        "eye segmentation": ("2D", "/world/cameras/eye", ["$origin/segmentation"]),
        "hand rgb": ("2D", "/world/cameras/hand", ["$origin/rgb"]),
        "Reward": ("TimeSeries", "/reward", ["$origin/**"]),
        "Evaluate": ("TimeSeries", "/evaluate", ["/evaluate/success", "/evaluate/a\\/b", "/batch/mean"]),
        "Action": ("TimeSeries", "/action", ["$origin/**"]),
        "Events": ("TextLog", "/logs", ["$origin/**"]),
    }


def test_an_episode_of_numbers_alone_has_no_empty_views(make_episode: Maker, tmp_path: Path) -> None:
    bare = make_episode(2, action=np.zeros((2, 0), np.float32), action_names=())
    views = views_of(blueprint_of(bare.write(tmp_path).rrd))
    assert views.keys() == {"Scene", "Reward", "Events"}
    assert views["Scene"][2] == ["$origin/**"] and views["Events"][1] == "/logs/events"


@pytest.mark.parametrize(("count", "kind"), [(2, VERTICAL), (3, VERTICAL), (4, TABS)])
def test_many_cameras_are_in_tabs(make_episode: Maker, tmp_path: Path, count: int, kind: int) -> None:
    episode = make_episode(cameras=[camera(f"eye{k}", "rgb") for k in range(count)])
    blueprint = blueprint_of(episode.write(tmp_path).rrd)
    contents = [
        held["ContainerBlueprint:container_kind"]
        for held in blueprint.values()
        if len(held.get("ContainerBlueprint:contents", ())) == count
        and all(one.startswith("view/") for one in held["ContainerBlueprint:contents"])
        and "ContainerBlueprint:col_shares" not in held
    ]
    assert [kind] in contents


def test_the_eye_looks_at_the_movable_bodies_of_the_first_state(make_episode: Maker, tmp_path: Path) -> None:
    episode = make_episode(3)
    episode.geometry = replace(
        episode.geometry,
        body_names=("floor", "robot/hand", "cube"),
        body_kinds=("static", "link", "dynamic"),
        body_hidden=(False,) * 3,
        visuals=(),
    )
    episode.poses = np.zeros((4, 3, 7), np.float32)
    episode.poses[..., 3] = 1
    episode.poses[:, 0, :3] = -50
    episode.poses[:, 1, :3] = 2, 0, 1
    episode.poses[:, 2, :3] = 4, 2, 0
    episode.poses[1:, 2, :3] += 9
    episode.info = replace(episode.info, control_dt=0.04)
    blueprint = blueprint_of(episode.write(tmp_path).rrd)
    (eye,) = [held for entity, held in blueprint.items() if entity.endswith("EyeControls3D")]
    (target,) = eye["EyeControls3D:look_target"]
    np.testing.assert_allclose(target, [3, 1, 0.5], atol=1e-6)
    away = np.subtract(eye["EyeControls3D:position"][0], target)
    assert (away > 0).all() and np.linalg.norm(away) == pytest.approx(1.5 * 3, abs=0.1)
    assert blueprint["/time_panel"]["TimePanelBlueprint:fps"] == [25.0]
