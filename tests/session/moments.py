"""What a worker tells of a step, made by hand."""

from __future__ import annotations

import numpy as np

from workbench.core.step import StepResult
from workbench.session.messages import Restored, Stepped

N, BODIES = 3, 4


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


def mask_of(envs: tuple[int, ...]) -> np.ndarray:
    mask = np.zeros(N, bool)
    mask[list(envs)] = True
    return mask
