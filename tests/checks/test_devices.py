"""Rules for loops over envs, copies to the host and tensor devices, with tasks that break and keep them."""

from __future__ import annotations

import pytest

from tests.checks.checked import Checked, the_finding
from workbench.checks.run_rules import RuleResult

pytestmark = pytest.mark.thorough

AT = "        height = self.cube.pose.p[:, 2] - CUBE_HALF_SIZE\n"
WITH_DEVICE = "        with torch.device(self.device):\n            b = len(env_idx)\n"
GOAL = "            goal = cube + torch.tensor([GOAL_RADIUS + 0.1, 0, 0])\n"


def in_evaluate(checked: Checked, rule: str, *lines: str) -> RuleResult:
    return checked(rule, (AT, AT + "".join(f"        {line}\n" for line in lines)))


LOOPS = (
    "[i for i in range(self.num_envs)]",
    "for row in self.cube.pose.p: row + 1",
    "for i in range(len(self.cube._objs)): pass",
    "n = self.num_envs; [i for i in range(n)]",
    "torch.stack([p * 2 for p, q in zip(self.cube.pose.p, self.cube.pose.q)])",
)


def test_loops_over_envs_in_evaluate_and_in_what_it_calls(checked: Checked) -> None:
    method = "    def count(self):\n        return [i for i in range(self.num_envs)]  # called\n\n    def evaluate("
    calls = AT + "".join(f"        {line}\n" for line in (*LOOPS, "self.count()"))
    result = checked("loop-over-envs", ("    def evaluate(", method), (AT, calls))
    found = {finding.code: finding.function for finding in result.findings}
    assert found == {
        **dict.fromkeys(LOOPS, "evaluate"),
        "return [i for i in range(self.num_envs)]  # called": "count",
    }


def test_other_loops_are_not_taken_for_loops_over_envs(checked: Checked) -> None:
    lines = (
        "x, y, z = self.cube.pose.p[0]",
        "for actor in (self.cube, self.goal): actor.pose.p",
        "for joint in self.agent.robot.joints: joint.name",
        "for axis in self.cube.pose.p.T: axis + 1",
    )
    assert in_evaluate(checked, "loop-over-envs", *lines).state == "kept"


COPIES = {
    "float(distance[0])": "float(tensor)",
    "distance.max().item()": ".item()",
    "distance.cpu()": ".cpu()",
    "distance.tolist()": ".tolist()",
    "1 if (distance < 0.1).any() else 2": "if tensor:",
    "self.cube.pose[0].sp": ".cpu()",
    "torch.tensor([d.item() for d in distance])": "once for each env in each step",
}


def test_copies_to_the_host(checked: Checked) -> None:
    result = in_evaluate(checked, "device-copies", *COPIES)
    found = {finding.code: finding for finding in result.findings}
    assert found.keys() == COPIES.keys()
    for line, written in COPIES.items():
        assert written in found[line].message and found[line].count == 1, "the message holds the count"
    assert " once in each step" in found["distance.cpu()"].message


def test_copies_that_only_some_steps_make(checked: Checked) -> None:
    line = "[distance.cpu() for _ in range(self.seen // 3)]"
    seen = GOAL, f"{GOAL}            self.seen = 0\n"
    edits = seen, (AT, f"{AT}        self.seen += 1\n        {line}\n")
    message = the_finding(checked("device-copies", *edits)).message
    assert "2 times in 3 steps" in message


def test_copies_of_host_tensors_and_at_resets_are_not_reported(checked: Checked) -> None:
    edits = (
        (AT, f"{AT}        float(torch.tensor([1.0, 2.0])[0])\n"),
        (GOAL, f"{GOAL}            cube.cpu()\n"),
    )
    assert checked("device-copies", *edits).state == "kept"


MEET = (
    "distance + torch.zeros(self.num_envs)",
    "torch.where(distance < 1, torch.ones(1).expand(self.num_envs), distance)",
    "x = torch.zeros(self.num_envs) * 2; torch.stack([x, distance])",
    "x[distance < 1]",
    "distance.clone()[distance < 1] = torch.zeros(self.num_envs)[distance.cpu() < 1]",
    "distance.cpu() + distance",
    "distance + torch.from_numpy(np.zeros(self.num_envs))",
    "distance + torch.zeros(self.num_envs, device='cpu')",
    "torch.zeros(self.num_envs, device=x.device) + distance",
    "Pose.create_from_pq(torch.zeros((self.num_envs, 3))).p + self.cube.pose.p",
)


def test_operations_that_mix_host_and_device_tensors(checked: Checked) -> None:
    result = in_evaluate(checked, "foreign-device", *MEET)
    assert {finding.code for finding in result.findings} == set(MEET)
    assert {finding.function for finding in result.findings} == {"evaluate"}


def test_operations_that_a_gpu_accepts(checked: Checked) -> None:
    lines = (
        "distance + torch.tensor(2.0)",  # no dimension
        "distance[torch.arange(2)]",  # an index
        "self.cube.pose.p.clone()[:, :2] = torch.zeros(2)",  # the assignment copies to the device
        "distance + torch.zeros(self.num_envs).to(self.device)",
        "distance + torch.zeros(self.num_envs).to(distance)",
        "distance + torch.zeros(self.num_envs).type_as(distance)",
        "distance + torch.zeros(self.num_envs, device=self.device)",
        "distance + torch.zeros_like(distance)",
        "distance + distance.new_zeros(self.num_envs)",
        "x = torch.zeros(3) + torch.ones(3)",  # both on the host
        "distance.clone().copy_(torch.zeros(self.num_envs))",
        "Pose.create_from_pq(torch.zeros((self.num_envs, 3)), device=self.device).p + self.cube.pose.p",
        "Pose.create_from_pq(torch.zeros((1, 3))).p + torch.ones((1, 3))",
        "distance + torch.Tensor([1])",  # its creation is not tracked
        "self.cube.pose * sapien.Pose(p=[0, 0, 1])",
        "with torch.device(self.device): distance + torch.zeros(self.num_envs)",
    )
    assert in_evaluate(checked, "foreign-device", *lines).state == "kept"


def test_a_reset_and_a_build_without_a_device(checked: Checked) -> None:
    no_context = WITH_DEVICE, "        if True:\n            b = len(env_idx)\n"
    # A reset whose tensors all stay on the host works: set_pose() moves them.
    assert checked("foreign-device", no_context).state == "kept"
    mixed = GOAL, "            goal = self.cube.pose.p[env_idx] + torch.tensor([GOAL_RADIUS + 0.1, 0, 0])\n"
    finding = the_finding(checked("foreign-device", no_context, mixed))
    assert finding.function == "_initialize_episode" and finding.code.startswith("goal =")
    assert checked("foreign-device", mixed).state == "kept"
    buffer = '        self.goal = builder.build_kinematic(name="goal")\n'
    kept = buffer, f"{buffer}        self.best = torch.zeros(self.num_envs)\n"
    finding = the_finding(checked("foreign-device", kept, (AT, f"{AT}        self.best + distance\n")))
    assert "made in line" in finding.message and finding.code == "self.best + distance"
