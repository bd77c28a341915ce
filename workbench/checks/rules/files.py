"""Checks of the files that a task names: whether they exist, and whether downloads are declared."""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mani_skill import ASSET_DIR
from mani_skill.utils import assets

from workbench.checks.evidence.collect import Checkup, Found, Note
from workbench.checks.evidence.places import Module
from workbench.checks.register_rule import rule
from workbench.checks.rules.source import HOOKS
from workbench.envs.assets import assets_at
from workbench.envs.broken_rule import Place

_SUFFIXES = {
    ".urdf", ".xml", ".mjcf", ".srdf", ".glb", ".gltf", ".obj", ".stl", ".ply", ".dae", ".usd", ".png", ".jpg", ".jpeg",
    ".hdr", ".exr", ".ktx", ".json", ".yaml", ".yml", ".npz", ".npy", ".pt", ".pth", ".pkl", ".h5", ".csv", ".svg",
}  # fmt: skip
_LOADS = {
    "load",
    "parse",
    "open",
    "load_json",
    "load_yaml",
    "load_npz",
    "read_text",
    "read_bytes",
    "loadtxt",
    "imread",
}
_WRITES_OR_ASKS = {
    "mkdir", "makedirs", "exists", "is_file", "is_dir", "isfile", "isdir", "write_text", "write_bytes", "save", "savez",
    "savez_compressed", "savetxt", "dump", "export", "imwrite", "to_csv", "glob", "listdir", "iterdir",
}  # fmt: skip
_DATASET_IDS = {"ycb:": "ycb"}
"""The download that has a model, by the prefix of the model's id: ``get_actor_builder(scene,
id="ycb:...")``."""


@dataclass(frozen=True)
class NamedFile:
    """A path in the source whose value is known."""

    path: Path
    place: Place
    relative: bool
    """Whether the path depends on the current folder of the process."""
    always: bool
    """Whether the line is in no branch of an ``if`` or ``try``."""


@rule("missing-file", "stop", "class")
def missing_file(checkup: Checkup) -> Iterator[Found | Note]:
    """Files that the task names exist.

    The task cannot be built on another machine.

    ## Why
    A path that exists on one machine only, a mesh that was not committed or a name with a typo stops the
    build on every other machine. On a cluster that happens after the job was scheduled.

    ## Fix
    Keep files next to the task's file, and find them from there.

    ```python fragment
    FOLDER = Path(__file__).parent
    builder.add_visual_from_file(str(FOLDER / "meshes" / "cup.glb"))
    ```

    ## How it is checked
    The rule reads the source of the hooks and of the functions that they call. It works out paths made of
    constants, `__file__`, `Path`, `os.path` and variables that are assigned once, without calling the
    author's code. It leaves out functions that write files or ask whether a file exists, and paths in
    ManiSkill's folder of downloads (see the rule `undeclared-assets`). If part of a path is known only while
    the task runs, the rule checks the folders before that part.
    """
    for named in _named_files(checkup):
        if ASSET_DIR in named.path.parents or named.path.exists():
            continue
        beside = Path(named.place[0]).parent / named.path
        if named.relative and beside.exists():
            yield Found(
                f"{named.path} is found only if the process starts in the folder of the task's file. Write "
                f"Path(__file__).parent / {str(named.path)!r}.",
                named.place,
            )
        else:
            yield Found(
                f"There is no {named.path}. Put the file next to the task's file, and write Path(__file__).parent / ....",
                named.place,
            )


@rule("undeclared-assets", "warn", "class")
def undeclared_assets(checkup: Checkup) -> Iterator[Found | Note]:
    """Assets that need a download are named in asset_download_ids.

    ManiSkill asks for the download at a prompt that nobody answers on a cluster, or the build fails because the
    files are missing.

    ## Why
    `asset_download_ids` tells ManiSkill what to fetch before the task is made. Without it, the build fails on
    a machine that has not downloaded the assets, or waits at a prompt that a cluster does not have.

    ## Fix
    Name the download in the registration.

    ```python fragment
    @register_env("PickBowl-v1", max_episode_steps=100, asset_download_ids=["ycb"])
    class PickBowlEnv(BaseEnv): ...
    ```

    ## How it is checked
    The rule reads the source of the hooks and of the functions that they call, and looks for paths in
    ManiSkill's download folder and for ids such as `ycb:024_bowl`. It skips code inside an `if`, since the
    task may work without it. It does not see downloads that one of ManiSkill's scene builders uses, or that a
    robot needs.
    """
    env_id = checkup.loaded.env_id
    declared = set(checkup.loaded.asset_ids)
    for name in checkup.loaded.asset_ids:
        if name in assets.DATA_GROUPS:
            declared.update(assets.expand_data_group_into_individual_data_source_ids(name))
    needed: dict[str, Place] = {}
    for named in _named_files(checkup):
        names = assets_at(named.path) if named.always and ASSET_DIR in named.path.parents else []
        if names and declared.isdisjoint(names):
            needed.setdefault(names[-1], named.place)
    for module, function in checkup.places.reached_from(*HOOKS):
        branches = _branches(function)
        for node in ast.walk(function):
            for prefix, name in _DATASET_IDS.items():
                text = node.value if isinstance(node, ast.Constant) and node not in branches else None
                if isinstance(text, str) and text.startswith(prefix) and name not in declared:
                    needed.setdefault(name, module.place(node, function.name))
    for name, place in needed.items():
        yield Found(
            f"The task needs the download {name}, which its registration does not declare. Write "
            f'@register_env("{env_id}", ..., asset_download_ids=[{name!r}]).',
            place,
        )


def _named_files(checkup: Checkup) -> Iterator[NamedFile]:
    checkup.require_source()
    for module, function in checkup.places.reached_from(*HOOKS):
        calls = {node.func for node in ast.walk(function) if isinstance(node, ast.Call)}
        if not _WRITES_OR_ASKS.isdisjoint(getattr(each, "attr", getattr(each, "id", "")) for each in calls):
            continue  # the function makes the files, or asks whether they exist
        values = _Values(checkup, module, function)
        branches = _branches(function)
        for node, path in _paths_in(function, values):
            place = module.place(node, function.name)
            yield NamedFile(path, place, not path.is_absolute(), node not in branches)


def _branches(function: ast.FunctionDef) -> set[ast.AST]:
    """The nodes within an ``if``, a conditional expression or a ``try``."""
    return {
        part
        for node in ast.walk(function)
        if isinstance(node, (ast.If, ast.IfExp, ast.Try))
        for part in ast.walk(node)
    }


def _paths_in(node: ast.AST, values: _Values) -> Iterator[tuple[ast.AST, Path]]:
    """The outermost expressions that are paths, with their values."""
    if isinstance(node, ast.Call):
        yield from _loaded_by(node, values)
    value = (
        values.of(node)
        if isinstance(node, ast.expr) and not isinstance(node, (ast.Name, ast.Constant))
        else None
    )
    if isinstance(value, (str, Path)):
        path = Path(value)
        if path.is_absolute() and (isinstance(value, Path) or path.suffix.lower() in _SUFFIXES):
            yield node, path
        return
    for child in ast.iter_child_nodes(node):
        yield from _paths_in(child, values)


def _loaded_by(call: ast.Call, values: _Values) -> Iterator[tuple[ast.AST, Path]]:
    """The files that a call reads, from its first argument and from ``filename=``, ``path=`` or ``file=``. An
    absolute path counts only if the argument is a name or a constant: `_paths_in` finds the others."""
    name = getattr(call.func, "attr", getattr(call.func, "id", ""))
    if name not in _LOADS and not name.endswith("_from_file"):
        return
    mode = [values.of(each) for each in call.args[1:2]] if name == "open" else []
    if any(isinstance(each, str) and not each.startswith("r") for each in mode):
        return
    given = [
        *call.args[:1],
        *(each.value for each in call.keywords if each.arg in ("filename", "path", "file")),
    ]
    for node in given:
        value = values.of(node)
        if not isinstance(value, (str, Path)) or Path(value).suffix.lower() not in _SUFFIXES:
            continue
        path = Path(value)
        if isinstance(node, (ast.Name, ast.Constant)) or not path.is_absolute():
            yield node, path


class _Values:
    """Works out expressions that make paths, without calling the author's code."""

    def __init__(self, checkup: Checkup, module: Module, function: ast.FunctionDef) -> None:
        self._cls = checkup.loaded.cls
        self._file = module.file
        self._globals = next(
            (
                vars(each)
                for each in list(sys.modules.values())
                if getattr(each, "__file__", None) == module.file
            ),
            {},
        )
        stored: dict[str, list[ast.expr]] = {}
        for node in ast.walk(function):
            if (
                isinstance(node, ast.Assign)
                and len(node.targets) == 1
                and isinstance(node.targets[0], ast.Name)
            ):
                stored.setdefault(node.targets[0].id, []).append(node.value)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                stored.setdefault(node.id, [])
        self._locals = {name: found[0] if len(found) == 1 else None for name, found in stored.items()}
        self._locals |= dict.fromkeys((each.arg for each in function.args.args), None)
        self._open: set[str] = set()

    def of(self, node: ast.AST) -> Any:
        """The value of the expression if it is a str, a Path, a number or a module; else None."""
        if isinstance(node, ast.Constant):
            return node.value
        if isinstance(node, ast.Name):
            return self._name(node.id)
        if isinstance(node, ast.JoinedStr):
            parts = [
                self.of(each.value if isinstance(each, ast.FormattedValue) else each) for each in node.values
            ]
            plain = all(
                not isinstance(each, ast.FormattedValue) or each.format_spec is None for each in node.values
            )
            known = plain and all(isinstance(each, (str, Path, int)) for each in parts)
            return "".join(map(str, parts)) if known else None
        if isinstance(node, ast.BinOp):
            left, right = self.of(node.left), self.of(node.right)
            if isinstance(node.op, ast.Div) and isinstance(left, Path) and isinstance(right, (str, Path)):
                return left / right
            if isinstance(node.op, ast.Add) and isinstance(left, str) and isinstance(right, str):
                return left + right
            return None
        if isinstance(node, ast.Attribute):
            return self._attribute(node)
        if isinstance(node, ast.Subscript):
            parents, index = self.of(node.value), self.of(node.slice)
            is_known = (
                isinstance(parents, tuple)
                and isinstance(index, int)
                and -len(parents) <= index < len(parents)
            )
            return parents[index] if is_known else None
        return self._call(node) if isinstance(node, ast.Call) else None

    def _name(self, name: str) -> Any:
        if name in self._locals:
            value = self._locals[name]
            if value is None or name in self._open:
                return None
            self._open.add(name)
            try:
                return self.of(value)
            finally:
                self._open.discard(name)
        value = self._file if name == "__file__" else self._globals.get(name)
        return value if isinstance(value, (str, Path, int, type(os))) else None

    def _attribute(self, node: ast.Attribute) -> Any:
        if isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"):
            found = vars(self._cls).get(node.attr)
        else:
            owner = self.of(node.value)
            if isinstance(owner, Path):
                known = {"parent": owner.parent, "name": owner.name, "stem": owner.stem}
                return tuple(owner.parents) if node.attr == "parents" else known.get(node.attr)
            found = vars(owner).get(node.attr) if isinstance(owner, type(os)) else None
        return found if isinstance(found, (str, Path, int, type(os))) else None

    def _call(self, node: ast.Call) -> Any:
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        given = [self.of(each) for each in node.args]
        if node.keywords or any(not isinstance(each, (str, Path)) for each in given):
            return None
        if isinstance(node.func, ast.Attribute):
            owner = self.of(node.func.value)
            if isinstance(owner, Path) and name in ("resolve", "absolute", "expanduser") and not given:
                return getattr(owner, name)()
            if isinstance(owner, Path) and name == "joinpath":
                return owner.joinpath(*given)
            if (
                owner is os.path
                and name in ("join", "dirname", "abspath", "realpath", "expanduser")
                and given
            ):
                return getattr(os.path, name)(*given)
        if name == "Path" and given:
            return Path(*given)
        return str(given[0]) if name in ("str", "fspath") and len(given) == 1 else None
