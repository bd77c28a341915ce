"""Planning by rollouts runs the same code on GPU simulation and on the batched CPU."""

from __future__ import annotations

import numpy as np
import pytest

import workbench
from tests.gpu.conftest import Simulation

pytestmark = pytest.mark.thorough

ENV_KWARGS = {"render_backend": "none", "control_mode": "pd_ee_delta_pose"}


@pytest.mark.slow
def test_a_plan_earns_at_least_as_much_as_holding_still(simulation: Simulation) -> None:
    env = workbench.make("PushCube-v1", 2, backend=simulation, **ENV_KWARGS)  # type: ignore[arg-type]
    rollouts = 64 if simulation == "gpu" else 16
    planner = workbench.Planner(env, rollouts=rollouts)
    env.reset(seed=0)
    planner.reset()
    reward = []
    for _ in range(5):
        _, earned, _, _, _ = env.step(planner.actions())
        reward.append(earned.cpu().numpy())  # type: ignore[attr-defined]
        for plan in planner.plans.values():
            assert np.isfinite(plan.rewards).all() and plan.rewards.shape == (rollouts, 10)
            assert plan.returns[plan.best] >= plan.returns[1]
    assert (reward[-1] > reward[0]).all()
    planner.close()
    env.close()
