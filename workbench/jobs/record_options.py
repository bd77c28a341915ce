"""What ``workbench record`` takes. Apart from what records, so that ``--help`` does not wait for torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RecordArguments:
    """
    Args:
        task: a task file, file.py:ClassName, package.module:ClassName, or a registered env id such as PickCube-v1.
        out: folder for the files.
        episodes: how many, over all envs; 4, or as many as a file of actions has.
        successes: go on until so many episodes succeeded, and keep no others.
        tries: give up after so many episodes where successes are wanted; 100 for each.
        actions: random, zero, hold; a policy as module:function or file.py:function; or a file: .npy or .npz with
            actions, or .h5 with ManiSkill's demonstrations, which begin from their own seeds.
        use_env_states: put every env state of a demonstration back after its step.
        pictures: record what every camera sees (--no-pictures is much faster).
        max_steps: longest episode; else the task's own limit, or 200 steps where it has none.
        workers: processes, each with its share of the envs; the episodes are the same with any number.
    """

    task: str
    out: Path = Path("recordings")
    episodes: int | None = None
    successes: int | None = None
    tries: int | None = None
    actions: str = "random"
    use_env_states: bool = False
    pictures: bool = True
    max_steps: int | None = None
    workers: int = 1
