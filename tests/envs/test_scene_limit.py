"""More envs than PhysX can have in a process are refused in words, not by the end of the process."""

from __future__ import annotations

import mani_skill.envs  # noqa: F401  registers the ids
import pytest
import sapien.physx as physx

from workbench.envs.cpu_scene import free_thread_keys, require_scenes


def test_each_physx_scene_takes_a_key_and_gives_it_back() -> None:
    first = physx.PhysxCpuSystem()  # what PhysX takes once is taken with it
    before = free_thread_keys()
    assert before is not None
    more = [physx.PhysxCpuSystem() for _ in range(5)]
    assert free_thread_keys() == before - 5
    del more
    assert free_thread_keys() == before
    del first


def test_what_fits_is_not_refused_and_one_more_is() -> None:
    require_scenes(500)
    with pytest.raises(ValueError, match=r"\d+ are left here") as caught:
        require_scenes(1024)
    room = int(str(caught.value).split(" are left here")[0].split()[-1])
    require_scenes(room)
    with pytest.raises(ValueError, match=f"{room} are left here"):
        require_scenes(room + 1)
