"""With ManiSkill's tasks and robots as authors' files, every camera is edited, or refused for a known reason."""

from __future__ import annotations

import ast
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mani_skill
import pytest
from mani_skill.sensors.camera import CameraConfig

from tests.cameras.edit.real_cameras import close, looking, settings_of
from workbench.cameras.edit.hook_cameras import HOOKS, HookCameras
from workbench.cameras.edit.plan import plan_edit
from workbench.cameras.edit.run_hooks import hook_camera, recording_calls
from workbench.envs.camera_data import CameraKey
from workbench.envs.maniskill_private import parse_cameras
from workbench.task.write_edits import SourceEdit

pytestmark = pytest.mark.thorough

PACKAGE = Path(mani_skill.__file__).parent
FILES = sorted(
    path
    for folder in ("envs", "agents")
    for path in (PACKAGE / folder).rglob("*.py")
    if "CameraConfig(" in path.read_text()
)
TASK = "/author/task.py"


class Anything:
    """Stand-in for a task: has any attribute that a hook reads, such as an agent or links to mount cameras on."""

    robot_uids = "panda"
    domain_randomization = False

    def __getattr__(self, name: str) -> Anything:
        return self

    def __getitem__(self, key: object) -> Anything:
        return self


def hook_results(path: Path, text: str) -> dict[tuple[str, int], dict[str, CameraConfig]]:
    """Return each hook's cameras by the hook's name and its index among hooks of that name in the file."""
    tree = ast.parse(text)
    top = [s for s in tree.body if isinstance(s, (ast.Import, ast.ImportFrom)) or _constant(s)]
    module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    names: dict[str, Any] = {
        "__name__": module,
        "__package__": module.rpartition(".")[0],
        "__file__": TASK,
    }
    exec(compile(ast.Module(top, []), TASK, "exec"), names)
    found: dict[tuple[str, int], dict[str, CameraConfig]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and node.name in HOOKS and "CameraConfig(" in ast.unparse(node):
            node.decorator_list, node.returns = [], None
            exec(compile(ast.Module([node], []), TASK, "exec"), names)
            count = sum(name == node.name for name, _ in found)
            try:
                found[node.name, count] = parse_cameras(names[node.name](Anything()))
            except (TypeError, ValueError):  # the hook needs numbers that only a real task has
                found[node.name, count] = {}
    return found


def _constant(statement: ast.stmt) -> bool:
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    return bool(targets) and all(isinstance(target, ast.Name) for target in targets)


def ran(path: Path, text: str, hook: tuple[str, int]) -> HookCameras:
    """Return one hook's cameras in the form in which a worker reports them."""
    with recording_calls({TASK: text}) as recorded:
        configs = hook_results(path, text)[hook]
    return HookCameras(
        {(HOOKS[hook[0]], uid): hook_camera(config, recorded) for uid, config in configs.items()}, {}
    )


def kinds_of_cameras() -> Iterator[Any]:
    """Yield one camera for each way of writing, ignoring numbers."""
    seen: set[str] = set()
    for path in FILES:
        functions = {}
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and "CameraConfig(" in (code := ast.unparse(node)):
                functions[node.lineno] = re.sub(
                    r"\"[^\"]*\"|'[^']*'|-?\d[\d.]*", "0", code.partition("\n")[2]
                )
        for line, code in functions.items():
            if code not in seen:
                seen.add(code)
                yield pytest.param(path, line, id=f"{path.stem}:{line}")


@pytest.mark.parametrize(("path", "first_line"), list(kinds_of_cameras()))
def test_each_camera_is_edited_correctly(path: Path, first_line: int) -> None:
    text = path.read_text()
    function = next(n for n in ast.walk(ast.parse(text)) if getattr(n, "lineno", 0) == first_line)
    lines = range(first_line, getattr(function, "end_lineno", 0) + 1)
    for hook, configs in hook_results(path, text).items():
        here = ran(path, text, hook)
        for uid, config in configs.items():
            key: CameraKey = (HOOKS[hook[0]], uid)
            before = settings_of(config)
            site = here.cameras[key].site
            if site is None or site.line not in lines:
                continue
            eye = (before.position[0] + 0.11, before.position[1] + 0.02, before.position[2] + 0.21)
            after = dataclasses.replace(before, position=eye, quaternion=looking(eye, (0.01, 0.02, 0.03)))
            if before.fov is not None:
                after = dataclasses.replace(after, fov=0.9)
            plan = plan_edit(
                {TASK: text}, key, before, after, lambda given, hook=hook: ran(path, given[TASK], hook)
            )
            assert isinstance(plan, SourceEdit) and plan.settings is not None, plan
            results = hook_results(path, plan.new_text)
            assert close(settings_of(results[hook][uid]), plan.settings), plan.diff
            for other, others in hook_results(path, text).items():
                for name, was in others.items():
                    if (other, name) != (hook, uid):
                        assert close(settings_of(results[other][name]), settings_of(was)), plan.diff
