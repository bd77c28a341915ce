"""What a worker tells of a step, made by hand."""

from __future__ import annotations

import numpy as np

from tests.ui.scenes import OUTLIER_FINDINGS
from workbench.core.env.step_result import StepResult
from workbench.core.scene.shapes import SceneGeometry
from workbench.jobs.task import Restored, Stepped
from workbench.session.history.env_table import EnvTable
from workbench.session.process.supervisor import Death, End

N, BODIES = 3, 4
DEATH = Death("was killed by SIGSEGV", End.DIED, "stepping", "", False)


def stepped(
    number: int,
    jumped: tuple[int, ...] = (),
    success: tuple[int, ...] = (),
    truncated: tuple[int, ...] = (),
    restored: Restored | None = None,
    keys: tuple[int, ...] | None = None,
    new: dict[int, bytes] | None = None,
) -> Stepped:
    step = StepResult(
        elapsed_steps=np.full(N, number, np.int32),
        reward=np.full(N, number, np.float32),
        terminated=mask_of(success),
        truncated=mask_of(truncated),
        evaluate={"success": mask_of(success), "fail": mask_of(())},
        poses=np.zeros((N, BODIES, 7), np.float32),
        action=None if jumped else np.zeros((N, 2), np.float32),
    )
    mask = mask_of(jumped)
    return Stepped(step, mask, (), None, b"body %d" % number, keys, new or {}, number, restored)


def table(first: StepResult | None = None) -> EnvTable:
    """Of a scene in which nothing moves, and which begins with this state."""
    first = stepped(0).step if first is None else first
    count, bodies = first.poses.shape[:2]
    names = tuple(f"body {k}" for k in range(bodies))
    geometry = SceneGeometry(count, names, ("static",) * bodies, (False,) * bodies, ())
    return EnvTable(geometry, first, 0.05, "dense", OUTLIER_FINDINGS)


def mask_of(envs: tuple[int, ...]) -> np.ndarray:
    mask = np.zeros(N, bool)
    mask[list(envs)] = True
    return mask
