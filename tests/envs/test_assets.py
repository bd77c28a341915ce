"""Missing assets are reported with their download command; nothing prompts and nothing is downloaded."""

# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import pytest
from mani_skill import ASSET_DIR
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import assets, download_asset

from tests.drive.envs import batched
from workbench.envs.assets import MissingAssets, assets_at, refuse_downloads, require_assets, robots_of

NOT_HERE = "anymal_c"


@pytest.fixture(autouse=True)
def nothing_is_downloaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for source in assets.DATA_SOURCES.values():
        monkeypatch.setattr(source, "output_dir", tmp_path)
        # An absolute target path overrides the patched folder.
        if source.target_path is not None and Path(source.target_path).is_absolute():
            monkeypatch.setattr(source, "target_path", Path(source.target_path).relative_to(ASSET_DIR))


def test_declared_assets_are_named_with_the_command_for_each() -> None:
    with pytest.raises(MissingAssets) as caught:
        require_assets("PickClutter", ["ycb", "pick_clutter_ycb_configs"])
    assert caught.value.names == ("ycb", "pick_clutter_ycb_configs")
    for name in caught.value.names:
        assert f"\n  python -m mani_skill.utils.download_asset {name}" in str(caught.value)


def test_a_missing_robot_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from mani_skill.agents.robots import ANYmalC

    monkeypatch.setattr(ANYmalC, "urdf_path", str(tmp_path / "robots" / "anymal_c" / "urdf" / "anymal.urdf"))
    for robots in (NOT_HERE, ("panda", NOT_HERE), ANYmalC):
        with pytest.raises(MissingAssets) as caught:
            require_assets("AnymalReach", [], robots)
        assert caught.value.names == (NOT_HERE,)


def test_assets_of_a_path_list_the_outermost_download_first(tmp_path: Path) -> None:
    scenes = tmp_path / "scene_datasets" / "replica_cad_dataset"
    assert assets_at(scenes / "configs" / "x.json") == ["ReplicaCAD"]
    # Fetching ReplicaCAD empties its folder, so the other must be fetched after it.
    assert assets_at(scenes / "rearrange" / "x.json") == ["ReplicaCAD", "ReplicaCADRearrange"]
    assert assets_at(tmp_path / "scene_datasets") == []


@pytest.mark.parametrize("answer", ["0", "1"])
def test_prompts_and_downloads_raise_and_are_restored(answer: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MS_SKIP_ASSET_DOWNLOAD_PROMPT", answer)
    before = download_asset.prompt_yes_no, download_asset.download
    with pytest.raises(MissingAssets, match="download_asset ycb"), refuse_downloads("Some"):
        download_asset.download(assets.DATA_SOURCES["ycb"])
    with pytest.raises(MissingAssets, match="Some needs some scene"), refuse_downloads("Some"):
        download_asset.prompt_yes_no("Some needs some scene. Would you like to download it now?")
    assert (download_asset.prompt_yes_no, download_asset.download) == before


def test_an_error_about_a_downloadable_file_names_its_download(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.envs.assets.ASSET_DIR", tmp_path)
    missing = tmp_path / "scene_datasets" / "ai2thor" / "some.json"
    with pytest.raises(MissingAssets, match="download_asset AI2THOR") as caught, refuse_downloads("Some"):
        missing.read_text()
    assert isinstance(caught.value.__cause__, FileNotFoundError)
    with pytest.raises(MissingAssets, match="AI2THOR"), refuse_downloads("Some"):
        raise RuntimeError(f"failed to load mesh {missing}.")


def test_advice_of_maniskills_own_error_is_taken() -> None:
    with pytest.raises(MissingAssets) as caught, refuse_downloads("Some"):
        raise RuntimeError("Run `python -m mani_skill.utils.download_asset ycb` first")
    assert caught.value.names == ("ycb",)
    for text in ("python -m mani_skill.utils.download_asset no_such_thing", "something else"):
        with pytest.raises(KeyError), refuse_downloads("Some"):
            raise KeyError(text)


def test_the_robots_of_a_task_are_those_given_else_the_constructors_default() -> None:
    class Defaults:
        def __init__(self, robot_uids: Any = ("panda", "fetch")) -> None: ...

    class Passes:
        def __init__(self, **kwargs: Any) -> None: ...

    class Needs:
        def __init__(self, robot_uids: Any) -> None: ...

    assert robots_of(Defaults, {}) == ("panda", "fetch")
    assert (
        robots_of(Defaults, {"robot_uids": "so100"}) == robots_of(Passes, {"robot_uids": "so100"}) == "so100"
    )
    assert robots_of(Passes, {}) is robots_of(Needs, {}) is None


@pytest.mark.parametrize("path", ["arm.urdf", "robots/arm.urdf", "{folder}/arm.urdf"])
def test_a_robot_with_a_wrong_path_is_reported_with_the_whole_path_at_its_line(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A relative path begins in the working directory."""
    monkeypatch.chdir(tmp_path)

    class Arm(Panda):
        uid = "arm_that_is_not_registered"
        urdf_path = path.format(folder=tmp_path)

    class Task(BaseEnv):
        SUPPORTED_ROBOTS = None  # type: ignore[assignment]  # any

        def __init__(self, *args: Any, **kwargs: Any) -> None:
            robot: Any = Arm
            super().__init__(*args, robot_uids=robot, **kwargs)

    with pytest.raises(MissingAssets, match=r"arm\.urdf.*test_assets\.py:\d+") as caught:
        batched(Task)
    assert str(tmp_path / str(Arm.urdf_path)) in str(caught.value) and caught.value.place is not None
