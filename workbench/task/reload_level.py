"""Classifies what a save changed, and how much of the env must be rebuilt for it."""

from __future__ import annotations

import ast
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePath
from types import CodeType, FunctionType
from typing import Any, Literal

from workbench.task.call_graph import STATEMENTS, Key, TwoVersions, read_symbols
from workbench.task.kept_state import (
    changed_while_running,
    memoizing_statement,
    root_name,
    written_attributes,
)
from workbench.task.problem import hooks_of

Level = Literal["same", "patched", "cameras", "rebuilt"]
"""same: only comments, docstrings or layout changed. patched: only code that runs at steps and resets
changed; the new class is put on the live env. cameras: camera configs changed, and perhaps code that runs
at steps and resets; the scene stays. rebuilt: anything else changed."""

RESET_HOOKS = frozenset(hooks_of("reset"))
STEP_HOOKS = frozenset(hooks_of("step"))
REWARD_HOOKS = frozenset(hooks_of("reward"))
SCORING_HOOKS = REWARD_HOOKS.union(hooks_of("evaluate"), hooks_of("observation"))
"""Hooks that run at every step and change nothing; `BaseEnv.__init__` calls some of them in its first reset."""
CAMERA_HOOKS = frozenset(
    {
        *("_default_sensor_configs", "_default_human_render_camera_configs"),
        "_default_viewer_camera_configs",
    }
)
_RUNS_LATER = RESET_HOOKS | STEP_HOOKS | SCORING_HOOKS
_CAMERA_ATTRIBUTES = frozenset(
    (
        "_sensors _human_render_cameras _sensor_configs _human_render_camera_configs sensors "
        "human_render_cameras set_local_pose"
    ).split()
)
_RANDOM_NAMES = frozenset(
    "rand randn randint randperm uniform normal random choice _batched_episode_rng _episode_rng".split()
)
_MOVES = frozenset("pose get_pose raw_pose qpos get_qpos qvel linear_velocity".split())
_UNUSUAL_MEMBERS = frozenset(
    (
        "__getattr__ __getattribute__ __setattr__ __delattr__ __init_subclass__ __new__ __class_getitem__ "
        "__set_name__ __slots__ __prepare__ __del__"
    ).split()
)


@dataclass(frozen=True)
class Inherited:
    """Names that the task's class inherits from classes of libraries."""

    names: frozenset[str]
    used_at_build: frozenset[str] = frozenset()
    """Names that the code of these classes (except BaseEnv) uses: this code may call functions with these
    names while the env is built."""


@dataclass(frozen=True)
class Change:
    """The difference between two versions of a task."""

    level: Level
    reason: str
    """Reason for the page: ``only compute_dense_reward changed``."""
    hooks: frozenset[str] = frozenset()
    """Hooks of the task that may behave differently."""

    @property
    def tried_hooks(self) -> frozenset[str]:
        """The hooks that run only in a reset or a step, not when the current moment is scored again."""
        return self.hooks & (RESET_HOOKS | STEP_HOOKS)


class _NeedsRebuild(Exception):
    """The env must be rebuilt; the message is the reason."""


def find_change(
    old: Mapping[str, str], new: Mapping[str, str], file: str, class_name: str, inherited: Inherited
) -> Change:
    """The cheapest reload level that does not mix two versions of a task, given as texts by path.

    Building a scene takes a second and loses the current moment, and most saves change a line of the reward. So the two
    versions are compared symbol by symbol. The new file is executed as a whole at every level. What remains
    of the old version on a live env is what its building code made. Building code is `_load_scene` and the
    other build hooks, robots and other classes, module-level statements, and everything that these mention,
    directly or indirectly. A change in building code means rebuilt. Other code can be replaced unless state
    may outlive the replacement (`workbench.task.kept_state`): values that hooks keep between calls,
    module-level dicts and lists that are filled while the task runs, attributes that only the old version
    writes, objects of the author's classes. If code may reach further than the names in it (``exec``),
    nothing is replaced. In doubt the level is rebuilt: a wrong "rebuilt" costs a second, a wrong "patched"
    shows numbers of mixed code.

    Pure: nothing is imported or executed. Does not raise, whatever the texts contain.
    """
    if dict(old) == dict(new):
        return Change("same", "nothing changed")
    try:
        return _Comparison(old, new, (file, class_name), inherited).classify()
    except _NeedsRebuild as reason:
        return Change("rebuilt", str(reason))
    except (SyntaxError, ValueError):  # ValueError: a null byte
        return Change("rebuilt", "the previous version cannot be parsed as Python")
    except RecursionError:
        return Change("rebuilt", "the file is nested too deeply to be compared")


class _Comparison:
    def __init__(
        self, old: Mapping[str, str], new: Mapping[str, str], task: Key, inherited: Inherited
    ) -> None:
        self._versions = TwoVersions(old, new)
        self._task, self._inherited = task, inherited

    def classify(self) -> Change:
        family = self._family()
        self._refuse_another_order(family)
        if self._versions.changed:
            self._refuse_unusual_classes(family)
            self._refuse_if_built_of_it(family)
        # Checked for every edit: at every level the module's names are created again.
        self._refuse_kept_between_calls(family)
        if not self._versions.changed:
            return Change("same", "only comments, docstrings or layout changed")
        affected = self._versions.affected()
        self._refuse_memoized(affected)
        hooks = frozenset(key[1].rpartition(".")[2] for key in affected if self._is_hook(key, family))
        seen = self._versions.reach(self._versions.members(family, CAMERA_HOOKS))
        cameras = any(key in seen for key in self._versions.changed)
        if cameras:
            self._refuse_cameras_of_the_moment(seen)
        reason = f"only {_joined([self._label(key) for key in self._versions.changed])} changed"
        if not hooks and not cameras:
            reason += ", which no hook uses"
        elif hooks <= RESET_HOOKS and not cameras:
            reason += ": seen from the next reset on"
        return Change("cameras" if cameras else "patched", reason, hooks)

    def _family(self) -> set[Key]:
        """The task's class and its bases in the author's files."""
        if self._task not in self._versions.old or self._task not in self._versions.new:
            raise _NeedsRebuild(
                f"the class {self._task[1]} is not defined at the top of the file in both versions"
            )
        found: set[Key] = set()
        waiting = [self._task]
        while waiting:
            key = waiting.pop()
            if key in found:
                continue
            found.add(key)
            for symbol in self._versions.by_key[key]:
                if symbol.kind != "class":
                    raise _NeedsRebuild(f"{self._label(key)} is not an ordinary class")
                waiting += [
                    k for k in self._versions.mentioned(symbol) if self._versions.by_key[k][0].kind == "class"
                ]
        return found

    def _is_hook(self, key: Key, family: set[Key]) -> bool:
        return key in self._versions.members(family, _RUNS_LATER)

    # --- code that the live env was built by ---------------------------------------------------------

    def _build_roots(self, family: set[Key]) -> set[Key]:
        """Symbols that may run while the file is imported or the env is built."""
        found: set[Key] = set()
        siblings = self._versions.siblings(family)
        for symbol in self._versions.symbols:
            if symbol.key in siblings or (symbol.path, symbol.owner) in siblings:
                continue
            foreign_member = symbol.owner is not None and (symbol.path, symbol.owner) not in family
            if symbol.kind in ("statements", "class") or foreign_member:
                # These may be used without being named: a robot by its uid, an enum's members by their position.
                runs = True
            elif symbol.owner is None:
                runs = any(getattr(node, "decorator_list", ()) for node in symbol.nodes)
            elif (name := symbol.short) in _RUNS_LATER | CAMERA_HOOKS:
                runs = symbol.kind != "function"
            else:
                special = name.startswith("__") and name.endswith("__")
                runs = special or name in self._inherited.names or name in self._inherited.used_at_build
            found |= {symbol.key} if runs else set()
        return found

    def _refuse_if_built_of_it(self, family: set[Key]) -> None:
        built = self._versions.reach(self._build_roots(family))
        for key in self._versions.changed:
            if key not in built:
                continue
            by, how = built[key], self._change_kind(key)
            if by is None:
                raise _NeedsRebuild(f"{self._label(key)} {how}")
            while (before := built[by]) is not None:
                by = before
            raise _NeedsRebuild(f"{self._label(key)} {how}, which {self._label(by)} uses")
        for owner in sorted(family):
            for symbol in self._versions.by_key.get((owner[0], f"{owner[1]}.__init__"), ()):
                if _goes_on_after_super(symbol.nodes):
                    raise _NeedsRebuild(
                        f"{symbol.name} has code after super().__init__(), and that call has already reset the env"
                    )
        rewards = self._versions.members(family, REWARD_HOOKS)
        for key in self._versions.changed:
            if key in rewards and self._change_kind(key) != "changed":
                raise _NeedsRebuild(
                    f"{self._label(key)} {self._change_kind(key)}, so the reward mode is chosen again"
                )

    # --- code that cannot be analysed ----------------------------------------------------------------

    def _refuse_another_order(self, family: set[Key]) -> None:
        """Refuse a changed order of a class's members: the values of an enum and the order of a dataclass's
        arguments depend on it."""
        for key, versions in self._versions.by_key.items():
            if versions[0].kind != "class" or key in family or key in self._versions.changed:
                continue
            before, after = (
                [member.name for member in version.values() if (member.path, member.owner) == key]
                for version in (self._versions.old, self._versions.new)
            )
            if before != after:
                raise _NeedsRebuild(f"the members of {self._label(key)} changed, or their order")

    def _refuse_unusual_classes(self, family: set[Key]) -> None:
        for key in sorted(family):
            for symbol in self._versions.by_key[key]:
                (node,) = symbol.nodes
                assert isinstance(node, ast.ClassDef)
                if node.keywords or getattr(node, "type_params", ()):
                    raise _NeedsRebuild(f"the class {symbol.name} has keyword arguments or type parameters")
                for decorator in node.decorator_list:
                    if not ast.unparse(decorator).partition("(")[0].endswith("register_env"):
                        raise _NeedsRebuild(
                            f"the class {symbol.name} is decorated with {ast.unparse(decorator)}"
                        )
                for name in sorted(_UNUSUAL_MEMBERS):
                    if (symbol.path, f"{symbol.name}.{name}") in self._versions.by_key:
                        raise _NeedsRebuild(f"the class {symbol.name} has {name}")
        for symbol in self._versions.symbols:
            # Names of a library cannot reach the author's code.
            from_library = symbol.kind == "import" and symbol.short_names <= self._versions.libraries
            if symbol.dynamic is not None and not from_library:
                raise _NeedsRebuild(
                    f"{self._label(symbol.key)} uses `{symbol.dynamic}`, which may reach anything"
                )

    # --- state that may outlive a replacement of the code ---------------------------------------------

    def _refuse_kept_between_calls(self, family: set[Key]) -> None:
        found = changed_while_running(self._versions.symbols, self._versions.libraries)
        if found is not None:
            value, code = found
            raise _NeedsRebuild(
                f"{self._label(value.key)} may be changed while the task runs, by {self._label(code.key)}: "
                "executing the new file would set it back to its first value"
            )
        running = self._versions.reach(self._versions.members(family, _RUNS_LATER))
        for key, by in running.items():
            if by is not None and key not in family and self._versions.by_key[key][0].kind == "class":
                raise _NeedsRebuild(
                    f"{self._label(by)} uses the class {self._label(key)}, and instances of its old version may exist"
                )

    def _refuse_memoized(self, affected: set[Key]) -> None:
        libraries = self._versions.libraries
        for key in self._versions.reach(affected):
            for symbol in self._versions.by_key[key]:
                if symbol.kind != "function":
                    continue
                for node in symbol.nodes:
                    kept = memoizing_statement(node, libraries)
                    if kept is not None:
                        raise _NeedsRebuild(
                            f"{self._label(key)} may keep what the old version computed ({kept})"
                        )
        still_read = {name for symbol in self._versions.new.values() for name in symbol.mentions}
        for key in self._versions.changed:
            before, after = self._versions.old.get(key), self._versions.new.get(key)
            lost = written_attributes(before) - written_attributes(after)
            for name in sorted(lost & still_read):
                raise _NeedsRebuild(f"{self._label(key)} no longer writes {name}, which is still read")

    def _refuse_cameras_of_the_moment(self, seen: Collection[Key]) -> None:
        """New cameras must equal those of a new env, so their code must not depend on the current moment."""
        for symbol in self._versions.symbols:
            label = self._label(symbol.key)
            if symbol.key not in seen:
                for name in sorted(symbol.mentions & _CAMERA_ATTRIBUTES):
                    raise _NeedsRebuild(f"{label} uses {name}, so the cameras may differ from their configs")
                continue
            for name in sorted(symbol.mentions & _RANDOM_NAMES):
                raise _NeedsRebuild(f"{label} uses {name}: the cameras would be sampled again")
            for node in (node for part in symbol.nodes for node in ast.walk(part)):
                moves = isinstance(node, ast.Attribute) and node.attr in _MOVES
                if moves and root_name(node) == "self":
                    raise _NeedsRebuild(f"{label} reads a pose when the scene is built")

    # --- texts --------------------------------------------------------------------------------------

    def _change_kind(self, key: Key) -> str:
        old, new = self._versions.old, self._versions.new
        return "is new" if key not in old else "is gone" if key not in new else "changed"

    def _label(self, key: Key) -> str:
        path, name = key
        if name.endswith(STATEMENTS):
            within = name.removesuffix(STATEMENTS).rstrip(".")
            return f"a statement at the top of {within or PurePath(path).name}"
        if path == self._task[0]:
            return name.removeprefix(f"{self._task[1]}.")
        return f"{name} of {PurePath(path).name}"


def _goes_on_after_super(nodes: Iterable[ast.AST]) -> bool:
    """Whether an ``__init__`` does more than set constants after ``BaseEnv.__init__`` has built and reset the
    env."""
    for node in nodes:
        if not isinstance(node, ast.FunctionDef):
            return True
        after = False
        for statement in node.body:
            calls = "super()" in ast.unparse(statement) or ".__init__(" in ast.unparse(statement)
            constant = isinstance(statement, ast.Assign) and isinstance(statement.value, ast.Constant)
            if calls and not isinstance(statement, ast.Expr):
                return True
            if after and not constant and not isinstance(statement, ast.Pass):
                return True
            after = after or calls
    return False


def _joined(names: list[str]) -> str:
    if len(names) > 4:
        return f"{', '.join(names[:3])} and {len(names) - 3} more"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


# --- what the import did ------------------------------------------------------------------------------


def removed_effects(old: Mapping[str, str], new: Mapping[str, str]) -> str:
    """Place and code of a statement that the old version ran at its import and that the new version lacks,
    such as ``push.py:7 (torch.set_num_threads(8))``; empty if there is none.

    Only statements with an effect outside their module count: a call, or an assignment to another module's
    attribute.
    """
    changed = [path for path in old if old[path] != new.get(path)]
    ran = [(path, *effect) for path in changed for effect in _effects(path, old[path])]
    kept = {dump for path, text in new.items() if ran for dump, _ in _effects(path, text)}
    for path, dump, statement in ran:
        if dump not in kept:
            code = ast.unparse(statement).partition("\n")[0]
            return f"{PurePath(path).name}:{statement.lineno} ({code})"
    return ""


def _effects(path: str, text: str) -> Iterator[tuple[str, ast.stmt]]:
    try:
        symbols = read_symbols(path, text)
    except (SyntaxError, ValueError, RecursionError):  # the new version, which is about to be refused
        return
    for symbol in symbols.values():
        for node in symbol.nodes if symbol.kind == "statements" else ():
            if isinstance(node, ast.stmt) and any(map(_has_effect, ast.walk(node))):
                yield ast.dump(node), node


def _has_effect(node: ast.AST) -> bool:
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Call)
    if isinstance(node, (ast.Assign, ast.Delete)):
        return any(isinstance(target, (ast.Attribute, ast.Subscript)) for target in node.targets)
    return isinstance(node, ast.AugAssign) and isinstance(node.target, (ast.Attribute, ast.Subscript))


# --- names of library classes ---------------------------------------------------------------------


def inherited_names(task: type, files: Collection[str]) -> Inherited:
    """Names that the class `task` inherits from classes of libraries; `files` are the author's."""
    from mani_skill.envs.sapien_env import BaseEnv  # the rest of this module needs no simulator

    libraries = [cls for cls in task.__mro__ if cls is not object and _file_of(cls) not in files]
    names = {name for cls in libraries for name in (*vars(cls), *vars(cls).get("__annotations__", ()))}
    basic = {*BaseEnv.__mro__}
    used = {name for cls in libraries if cls not in basic for name in _used_in(cls)}
    return Inherited(frozenset(names), frozenset(used))


def _file_of(cls: type) -> str | None:
    return getattr(sys.modules.get(cls.__module__), "__file__", None)


def _used_in(cls: type) -> Iterator[str]:
    for member in vars(cls).values():
        functions: list[Any] = [member]
        if isinstance(member, property):
            functions = [member.fget, member.fset]
        for function in functions:
            function = getattr(function, "__func__", function)
            if isinstance(function, FunctionType):
                yield from _names_in(function.__code__)


def _names_in(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _names_in(inner)
