"""Rules of the observation, each with a task that breaks it and one that keeps it."""

from __future__ import annotations

from tests.checks.checked import Checked, check_rule, the_finding

RULES = ("observation-finite", "observation-constant", "observation-huge")
GOAL = '"goal_pos": self.goal.pose.p,'
HIDDEN_GOAL = (
    'self.goal = builder.build_kinematic(name="goal")\n',
    "        self._hidden_objects.append(self.goal)\n",
)


def test_an_observation_that_is_nan(checked: Checked) -> None:
    edit = GOAL, '"goal_pos": self.goal.pose.p / (info["cube_to_goal"] * 0)[:, None] * 0,'
    finding = the_finding(checked("observation-finite", edit))
    assert "'extra/goal_pos'" in finding.message and finding.code.startswith('"goal_pos"')
    assert finding.function == "_get_obs_extra" and finding.degree == "stop"


def test_an_observation_that_is_nan_where_random_actions_do_not_lead(checked: Checked) -> None:
    edit = GOAL, f"{GOAL} 'log': torch.log((info['cube_to_goal'] - 0.001).sign()),"
    assert "with bodies at the place of goal" in the_finding(checked("observation-finite", edit)).message


def test_an_observation_that_never_changes(checked: Checked) -> None:
    edit = GOAL, f"{GOAL} 'size': torch.full((self.num_envs, 1), CUBE_HALF_SIZE),"
    finding = the_finding(checked("observation-constant", edit))
    assert "'extra/size'" in finding.message and "0.02" in finding.message


def test_a_flag_that_random_actions_never_raise_is_noted(checked: Checked) -> None:
    result = checked("observation-constant", (GOAL, f"{GOAL} 'held': self.agent.is_grasping(self.cube),"))
    assert result.state == "kept" and "'extra/held'" in result.notes[0]


def test_what_the_robot_adds_and_never_changes_is_noted(checked: Checked) -> None:
    """The palm of a hand that is fixed; what the task adds beside it is the author's."""
    result = check_rule("observation-constant", "RotateSingleObjectInHandLevel0-v1", num_envs=2, seeds=2)
    assert result.state == "kept" and any("'agent/palm_pose'" in note for note in result.notes)
    extra = "    def _get_obs_extra("
    agent = (
        "    def _get_obs_agent(self):\n"
        "        return {**super()._get_obs_agent(), 'base': self.agent.robot.pose.p}\n\n"
    )
    finding = the_finding(checked("observation-constant", (extra, agent + extra)))
    assert "'agent/base'" in finding.message and finding.function == "_get_obs_agent"


def test_an_observation_in_millimetres(checked: Checked) -> None:
    finding = the_finding(checked("observation-huge", (GOAL, '"goal_pos": self.goal.pose.p * 1e6,')))
    assert "'extra/goal_pos'" in finding.message and finding.code.startswith('"goal_pos"')


def test_the_example_keeps_them(checked: Checked) -> None:
    for rule in RULES:
        assert checked(rule, obs_mode="state_dict").state == "kept"


def test_ground_truth_in_a_mode_with_pictures(checked: Checked, renderer: None) -> None:
    edit = GOAL, f'{GOAL} "cube_from_tcp": self.cube.pose.p - self.agent.tcp.pose.p,'
    finding = the_finding(checked("ground-truth", edit))
    assert "'cube_from_tcp' of _get_obs_extra() follows cube" in finding.message
    assert finding.code.startswith('"goal_pos"') and finding.function == "_get_obs_extra"
    assert checked("ground-truth").state == "kept"


def test_a_hidden_goal_that_the_policy_is_not_told(checked: Checked, renderer: None) -> None:
    hide = HIDDEN_GOAL[0], "".join(HIDDEN_GOAL)
    finding = the_finding(checked("hidden-goal", hide, (GOAL, "")))
    assert "goal is hidden from pictures" in finding.message and finding.code.startswith("def _get_obs_extra")
    assert checked("hidden-goal", hide).state == "kept"


MERGED_GOAL = """self.goal = builder.build_kinematic(name="one")
        self.remove_from_state_dict_registry(self.goal)
        self._hidden_objects.append(self.goal)
        from mani_skill.utils.structs import Actor
        self.goal = Actor.merge([self.goal], "goal")
        self.add_to_state_dict_registry(self.goal)
"""


def test_a_goal_whose_parts_are_hidden_is_hidden(checked: Checked, renderer: None) -> None:
    finding = the_finding(checked("hidden-goal", (HIDDEN_GOAL[0], MERGED_GOAL), (GOAL, "")))
    assert finding.function == "_get_obs_extra"


def test_without_hidden_bodies_there_is_no_hidden_goal(checked: Checked, renderer: None) -> None:
    assert checked("hidden-goal", (GOAL, "")).state == "skipped"
