"""ManiSkill's own tasks and robots as authors' files: every camera in them is edited, or refused for a known reason."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mani_skill
import pytest
from mani_skill.sensors.camera import CameraConfig, parse_camera_configs

from tests.authoring.camera_source.real_cameras import close, settings_of
from workbench.authoring.camera_source import Refusal, SourceEdit, plan_edit
from workbench.authoring.camera_source.definitions import Project
from workbench.authoring.camera_source.find import HOOKS, camera_calls
from workbench.authoring.camera_source.rotations import look_at, unit
from workbench.core.camera_settings import CallSite

PACKAGE = Path(mani_skill.__file__).parent
FILES = sorted(
    path
    for folder in ("envs", "agents")
    for path in (PACKAGE / folder).rglob("*.py")
    if "CameraConfig(" in path.read_text()
)
REASONS = (
    "cannot be read in the file",  # set from a table by the robot, as PickCube does
    "computed when the task runs",
    "the same values",
    "something else changes it",
)


class Anything:
    """A task that has whatever a hook asks it for: links to mount cameras on, an agent."""

    robot_uids = "panda"
    domain_randomization = False

    def __getattr__(self, name: str) -> Anything:
        return self

    def __getitem__(self, key: object) -> Anything:
        return self


def hook_results(path: Path, text: str) -> dict[tuple[str, int], dict[str, CameraConfig]]:
    """What each hook in the file returns, by its name and how many of that name came before."""
    tree = ast.parse(text)
    top = [s for s in tree.body if isinstance(s, (ast.Import, ast.ImportFrom, ast.Assign, ast.AnnAssign))]
    module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    names: dict[str, Any] = {
        "__name__": module,
        "__package__": module.rpartition(".")[0],
        "__file__": str(path),
    }
    exec(compile(ast.Module(top, []), str(path), "exec"), names)
    found: dict[tuple[str, int], dict[str, CameraConfig]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and node.name in HOOKS and "CameraConfig(" in ast.unparse(node):
            node.decorator_list, node.returns = [], None
            exec(compile(ast.Module([node], []), str(path), "exec"), names)
            count = sum(name == node.name for name, _ in found)
            try:
                found[node.name, count] = parse_camera_configs(names[node.name](Anything()))
            except (TypeError, ValueError):  # numbers that only a real task has
                found[node.name, count] = {}
    return found


def cameras(path: Path) -> Iterator[tuple[CallSite, tuple[str, int], str, CameraConfig]]:
    text = path.read_text()
    calls = list(camera_calls(project := Project({"/author/task.py": text}), project.file("/author/task.py")))
    for hook, configs in hook_results(path, text).items():
        for uid, config in configs.items():
            fitting = [call for call in calls if call.name == uid and call.hook == hook[0]]
            owners = list(
                dict.fromkeys(call.file.function(call.node) for call in calls if call.hook == hook[0])
            )
            fitting = [c for c in fitting if c.file.function(c.node) == owners[hook[1]]]
            for call in fitting:
                yield CallSite("/author/task.py", call.line, owners[hook[1]]), hook, uid, config


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_each_camera_is_edited_right_or_refused(path: Path) -> None:
    text = path.read_text()
    for site, hook, uid, config in cameras(path):
        before = settings_of(config)
        eye = (before.position[0] + 0.11, before.position[1] + 0.02, before.position[2] + 0.21)
        after = dataclasses.replace(before, position=eye, quaternion=unit(look_at(eye, (0.01, 0.02, 0.03))))
        if before.fov is not None:
            after = dataclasses.replace(after, fov=0.9)
        plan = plan_edit({"/author/task.py": text}, uid, before, after, site)
        if isinstance(plan, Refusal):
            assert any(reason in plan.reason for reason in REASONS), plan.reason
            continue
        assert isinstance(plan, SourceEdit) and plan.settings is not None
        results = hook_results(path, plan.new_text)
        assert close(settings_of(results[hook][uid]), plan.settings), plan.diff
        for other, configs in hook_results(path, text).items():
            for name, was in configs.items():
                if (other, name) != (hook, uid):
                    assert close(settings_of(results[other][name]), settings_of(was)), plan.diff


def test_most_of_them_can_be_edited() -> None:
    edited, refused = 0, []
    for path in FILES:
        for site, _, uid, config in cameras(path):
            before = settings_of(config)
            after = dataclasses.replace(before, position=(1.0, 2.0, 3.0), quaternion=unit((1, 2, 3, 4)))
            plan = plan_edit({"/author/task.py": path.read_text()}, uid, before, after, site)
            edited += isinstance(plan, SourceEdit)
            refused += [f"{path.stem}: {plan.reason}"] if isinstance(plan, Refusal) else []
    assert edited >= 80, refused
    assert len(refused) <= 4, refused
