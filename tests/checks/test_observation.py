"""Rules for observations, each with a task that breaks it and one that keeps it."""

from __future__ import annotations

import pytest

from tests.checks.checked import Checked, the_finding

pytestmark = pytest.mark.thorough

GOAL = '"goal_pos": self.goal.pose.p,'
HIDDEN_GOAL = (
    'self.goal = builder.build_kinematic(name="goal")\n',
    "        self._hidden_objects.append(self.goal)\n",
)


def test_an_observation_that_is_nan_in_states_that_random_actions_do_not_reach(checked: Checked) -> None:
    edit = GOAL, f"{GOAL} 'log': torch.log((info['cube_to_goal'] - 0.001).sign()),"
    finding = the_finding(checked("observation-finite", edit))
    assert "goal" in finding.message and finding.degree == "stop"
    assert finding.code.startswith('"goal_pos"') and finding.function == "_get_obs_extra"


def test_the_line_of_a_finding_writes_the_entry_and_does_not_only_read_it(checked: Checked) -> None:
    write = 'obs["size"] = torch.full((self.num_envs, 1), CUBE_HALF_SIZE)'
    edit = (
        "        return obs\n",
        f'        if info.get("size") is None:\n            {write}\n        return obs\n',
    )
    finding = the_finding(checked("observation-constant", edit))
    assert finding.code == write and "'extra/size'" in finding.message and "0.02" in finding.message


def test_ground_truth_in_a_mode_with_pictures(checked: Checked, renderer: None) -> None:
    edit = GOAL, f'{GOAL} "cube_from_tcp": self.cube.pose.p - self.agent.tcp.pose.p,'
    finding = the_finding(checked("ground-truth", edit))
    assert "'cube_from_tcp'" in finding.message and "cube" in finding.message.replace("cube_from_tcp", "")
    assert finding.code.startswith('"goal_pos"') and finding.function == "_get_obs_extra"


def test_noise_in_an_observation_follows_no_body(checked: Checked, renderer: None) -> None:
    edit = GOAL, f'{GOAL} "noise": torch.from_numpy(np.random.default_rng().random((self.num_envs, 1))),'
    assert checked("ground-truth", edit).state == "kept"


def test_a_hidden_goal_that_is_not_observed(checked: Checked, renderer: None) -> None:
    hide = HIDDEN_GOAL[0], "".join(HIDDEN_GOAL)
    finding = the_finding(checked("hidden-goal", hide, (GOAL, "")))
    assert "goal is hidden from pictures" in finding.message and finding.code.startswith("def _get_obs_extra")
    assert checked("hidden-goal", hide).state == "kept"
