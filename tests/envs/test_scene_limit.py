"""More envs than PhysX supports in one process raise an error and do not crash the process."""

from __future__ import annotations

import mani_skill.envs  # noqa: F401  registers the ids
import pytest
import sapien.physx as physx

from tests.drive.envs import batched
from workbench.envs.cpu_scene import free_thread_keys, require_scenes


def test_each_physx_scene_takes_a_key_and_releases_it() -> None:
    first = physx.PhysxCpuSystem()  # also takes the keys that PhysX uses once per process
    before = free_thread_keys()
    assert before is not None
    more = [physx.PhysxCpuSystem() for _ in range(5)]
    assert free_thread_keys() == before - 5
    del more
    assert free_thread_keys() == before
    del first


def test_only_more_envs_than_fit_are_refused() -> None:
    require_scenes(500)
    with pytest.raises(ValueError, match=r"\d+ are left here") as caught:
        require_scenes(1024)
    room = int(str(caught.value).split(" are left here")[0].split()[-1])
    require_scenes(room)
    with pytest.raises(ValueError, match=f"{room} are left here"):
        require_scenes(room + 1)


def test_an_env_that_does_not_fit_is_refused_before_anything_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    def build(*args: object) -> None:
        raise AssertionError("a scene was begun")

    monkeypatch.setattr(physx, "PhysxCpuSystem", build)
    with pytest.raises(ValueError, match="are left here"):
        batched("PickCube-v1", 5000)
