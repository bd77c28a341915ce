"""The place of a task's error as ``workbench check`` and ``record`` report it: file, line, and the errors before it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.drive.commands import exit_code, line_of
from tests.drive.session import TASKS

pytestmark = pytest.mark.thorough

FEW = ("--num-envs", "2", "--seeds", "2", "--workers", "1", "--env", "render_backend=none")
Check = Callable[..., dict[str, Any]]


@pytest.fixture
def check(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Check:
    """A function that checks ``runs`` on a task below `tmp_path` and returns its error or finding. Paths are relative."""
    (tmp_path / ".git").mkdir()
    monkeypatch.chdir(tmp_path)

    def run(task: str, *more: str) -> dict[str, Any]:
        capsys.readouterr()
        exit_code("check", task, "--select", "runs", "--json", *FEW, *more)
        report = json.loads(capsys.readouterr().out)
        return report["error"] or (report["findings"] or [{}])[0]

    return run


def edited(folder: Path, *edits: tuple[str, str]) -> Path:
    """Write the smallest example with these replacements."""
    text = (TASKS / "minimal.py").read_text()
    for old, new in edits:
        assert old in text, old
        text = text.replace(old, new)
    file = folder / "task.py"
    file.write_text(text)
    return file


RESET, EVALUATED = "        self.cube.set_pose(Pose.create_from_pq(p=p))\n", 'return {"success":'


def test_a_caught_refusal_of_the_core_is_reported_before_the_error_that_follows(
    tmp_path: Path, check: Check
) -> None:
    caught = """
        self.places = [1]
        try:
            self.moved()
        except ValueError:
            self.cube.set_pose(Pose.create_from_pq(p=p))
            self.places = []
        self.places[0]

    def moved(self):
        self.cube.set_pose(Pose.create_from_pq(torch.full((1, 3), torch.nan)))
"""
    file = edited(tmp_path, (RESET, caught))
    problem = check("task.py")
    assert problem["line"] == line_of(file, "self.places[0]") and problem["file"] == "task.py"
    message = problem["message"]
    refused, swallowed = (
        f"task.py:{line_of(file, words)}" for words in ("torch.full((1, 3), torch.nan)", "self.moved()")
    )
    assert message.index(refused) < message.index(swallowed) < message.index("IndexError"), message
    assert "NaN" in message
    # A refusal without a later error is not reported, and is not part of the next call's error.
    file.write_text(file.read_text().replace("        self.places[0]\n", ""))
    assert check("task.py") == {}
    file.write_text(
        file.read_text().replace(
            "    def moved", "    def _before_control_step(self):\n        {}[9]\n\n    def moved"
        )
    )
    assert "NaN" not in check("task.py")["message"]


@pytest.mark.parametrize(
    ("line", "without"),
    [
        (
            "    def _initialize_episode(self, env_idx, options):\n",
            "    def _initialize_episode(self, env_idx):\n",
        ),
        (
            "    def evaluate(self):\n",
            "    def get_obs(self, info=None):\n        return super().get_obs(info)\n\n    def evaluate(self):\n",
        ),
    ],
)
def test_a_method_that_lacks_an_argument_is_reported_at_its_def(
    line: str, without: str, tmp_path: Path, check: Check
) -> None:
    text = (TASKS / "minimal.py").read_text()
    head = line.split("(")[0]
    given = next(each for each in text.splitlines(keepends=True) if each.startswith(head))
    file = edited(tmp_path, (given, without))
    problem = check("task.py")
    assert problem["line"] == line_of(file, without.split("\n")[0]) and problem["file"] == "task.py"
    assert "TypeError" in problem["message"]


def test_the_first_exception_of_a_chain_is_reported_with_its_line(tmp_path: Path, check: Check) -> None:
    chain = """
        try:
            {}["table"]
        except KeyError as error:
            raise ValueError("no such place") from error
"""
    file = edited(tmp_path, (RESET, chain))
    problem = check("task.py")
    assert problem["line"] == line_of(file, "raise ValueError")
    assert problem["message"].index(f"task.py:{line_of(file, '{}[')}") < problem["message"].index(
        "ValueError"
    )


def test_an_entry_without_rows_is_named_when_another_hook_fails_with_it(tmp_path: Path, check: Check) -> None:
    hooks = """apart = self.cube.pose.p[:1, 0].repeat(3)
        return {
            "apart": apart,
            "success": torch.zeros(self.num_envs, dtype=torch.bool),
        }

    def compute_dense_reward(self, obs, action, info):
        return info["apart"] + self.cube.pose.p[:, 0]

    def compute_normalized_dense_reward(self, obs, action, info):
        return self.compute_dense_reward(obs, action, info)

    def old(self):
        return {"success":"""
    file = edited(tmp_path, (EVALUATED, hooks), ('("sparse", "none")', '("normalized_dense", "dense")'))
    problem = check("task.py")
    assert problem["line"] == line_of(file, 'return info["apart"]')
    entry = line_of(file, '"apart": apart')
    assert "(3,)" in problem["message"] and f"task.py:{entry}" in problem["message"]


BROKEN = {
    "a name": ("from typing import nothing_like_it\n", "from typing"),
    "a module": ("import os\nimport nothing_of_this_name\n", "import nothing"),
    "a syntax": ("x = 1\ny = = 2\n", "y ="),
    "at run time": ("SIZES = {}\nprint(SIZES['cube'])\n", "print"),
    "a circle": ("from LAB.tasks.reach import LabEnv\n", "tasks.reach"),
    "a relative one": ("from .nowhere import THING\n", "from .nowhere"),
    "a name of a package": ("from . import nothing_there\n", "from . import"),
}


@pytest.mark.parametrize("kind", BROKEN)
@pytest.mark.parametrize("where", ["robots/dual.py", "__init__.py", "robots/__init__.py"])
def test_a_module_of_another_folder_that_cannot_be_imported_is_named_with_its_line(
    kind: str, where: str, tmp_path: Path, check: Check
) -> None:
    text, words = BROKEN[kind]
    # Python caches packages that other tests of this process have imported.
    lab = f"lab_{kind.replace(' ', '_')}_{where.replace('/', '_').removesuffix('.py')}"
    names = ("__init__.py", "robots/__init__.py", "robots/dual.py", "tasks/__init__.py")
    files = dict.fromkeys(names, "") | {where: text.replace("LAB", lab)}
    files["tasks/reach.py"] = f"import {lab}.robots.dual\n" + (TASKS / "minimal.py").read_text()
    for name, held in files.items():
        file = tmp_path / lab / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(held)
    problem = check(f"{lab}/tasks/reach.py")
    assert (problem["file"], problem["line"]) == (f"{lab}/{where}", line_of(tmp_path / lab / where, words)), (
        problem
    )


ROBOT = """
from pathlib import Path
import numpy as np
import sapien
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.controllers import PDJointPosControllerConfig
from mani_skill.agents.registration import register_agent

@register_agent()
class Stick(BaseAgent):
    uid = "stick_of_NAME"
    KIND_path = str(Path(__file__).with_name("stick.xml"))
    keyframes = {"rest": Keyframe(pose=sapien.Pose(p=[0, 0, 0.05]), qpos=np.array([0.3]))}

    @property
    def _controller_configs(self):
        return {"pd": {"arm": PDJointPosControllerConfig(["hinge"], -0.1, 0.1, 1000, 100, use_delta=True)}}
"""
URDF = """<?xml version="1.0"?>
<robot name="stick">
  <link name="base">
    <inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
    <collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>
  </link>
  <link name="arm">
    <inertial><mass value="0.5"/><inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial>
    <collision><origin xyz="0 0 0.15"/><geometry><box size="0.03 0.03 0.3"/></geometry></collision>
  </link>
  <joint name="hinge" type="revolute">
    <parent link="base"/><child link="arm"/><origin xyz="0 0 0.06"/><axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="1.5" effort="10" velocity="3"/>
  </joint>
</robot>
"""
MJCF = """<mujoco model="stick">
  <worldbody>
    <body name="base" pos="0 0 0.05">
      <geom type="box" size="0.05 0.05 0.05"/>
      <body name="arm" pos="0 0 0.06">
        <joint name="hinge" type="hinge" axis="0 1 0" range="-1.5 1.5"/>
        <geom type="box" size="0.015 0.015 0.15" pos="0 0 0.15"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
MISTAKES = {
    "an inertia": (URDF, 'ixx="0.001"', 'ixx="-0.001"', '<link name="arm"', "arm"),
    "a link twice": (
        URDF,
        '<link name="arm"',
        '<link name="base"',
        '<link name="base">\n    <inertial><mass value="0.5"',
        "base",
    ),
    "no parent": (URDF, '<parent link="base"/>', '<parent link="bse"/>', '<joint name="hinge"', "hinge"),
    "not closed": (URDF, "</robot>\n", "", None, ""),
    "an element of MJCF": (
        MJCF,
        'type="box" size="0.015 0.015 0.15"',
        'type="box" size="0.015 thin 0.15"',
        "thin",
        "arm",
    ),
}


@pytest.mark.parametrize("kind", MISTAKES)
def test_an_error_in_a_robots_file_is_reported_with_its_line_and_the_line_naming_the_file(
    kind: str, tmp_path: Path, check: Check
) -> None:
    text, old, new, words, named = MISTAKES[kind]
    name = "mjcf" if text is MJCF else "urdf"
    robot = tmp_path / "stick.py"
    robot.write_text(ROBOT.replace("KIND", name).replace("NAME", kind.replace(" ", "_").replace("'", "")))
    described = tmp_path / "stick.xml"
    described.write_text(text.replace(old, new))
    problem = check("stick.py")
    line = text.replace(old, new).count("\n") + 1 if words is None else line_of(described, words)
    assert (problem["file"], problem["line"]) == ("stick.py", line_of(robot, f"{name}_path")), problem
    assert f"{described}:{line}" in problem["message"] and named in problem["message"], problem


def test_a_missing_file_or_joint_of_a_robot_is_reported_with_its_line(tmp_path: Path, check: Check) -> None:
    robot = tmp_path / "stick.py"
    text = ROBOT.replace("KIND", "urdf")
    robot.write_text(text.replace("NAME", "no_file"))
    problem = check("stick.py")
    assert (
        problem["line"] == line_of(robot, "urdf_path") and str(tmp_path / "stick.xml") in problem["message"]
    )
    (tmp_path / "stick.xml").write_text(URDF)
    robot.write_text(text.replace("NAME", "no_joint").replace('["hinge"]', '["hing"]'))
    problem = check("stick.py")
    assert problem["line"] == line_of(robot, '["hing"]') and "'hinge'" in problem["message"], problem


def test_a_missing_mesh_is_reported_with_the_link_naming_it(
    renderer: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    robot, described = tmp_path / "stick.py", tmp_path / "stick.xml"
    robot.write_text(ROBOT.replace("KIND", "urdf").replace("NAME", "no_mesh"))
    visual = '<visual><geometry><mesh filename="meshes/arm.stl"/></geometry></visual>'
    described.write_text(URDF.replace('<link name="arm">', f'<link name="arm">{visual}'))
    monkeypatch.chdir(tmp_path)
    assert exit_code("record", "stick.py", "--episodes", "1", "--num-envs", "1") == 1
    stderr = capsys.readouterr().err
    assert f"{robot}:{line_of(robot, 'urdf_path')}" in stderr, stderr
    assert f"{described}:{line_of(described, visual)}" in stderr and "'arm'" in stderr
    assert str(tmp_path / "meshes" / "arm.stl") in stderr
