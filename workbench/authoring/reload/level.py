"""What a save changed, and how little must be done about it.

Building a scene takes a second and throws away the moment that the author looks at; most saves change a line
of the reward. So the two versions are compared symbol by symbol, and the cheapest way to the new one is
chosen that cannot leave a stale mixture of both:

    same        only comments, docstrings or layout changed
    patched     only what runs at steps and resets changed: the new class can be put on the live env
    cameras     the cameras' configs changed too: the scene stays
    rebuilt     all else

The new file is executed whole in every case, so new code sees new constants and new helpers. What is left of the
old version on a live env is what its *building* made: `_load_scene` and the other hooks that ManiSkill calls while it
builds, robots and other classes, statements at the top, and whatever those mention, and what that mentions, and so
on. A change in there means rebuilt. The rest can be exchanged, unless something may outlive the exchange: values
that hooks keep between calls (`workbench.authoring.reload.memoizing`), dicts and lists at the top that are filled
while the task runs, attributes that the old version wrote and the new one only reads, objects of the
author's own classes. Where code may reach further than its names say (``exec``), nothing is exchanged. The heavier
level when unsure: a wrong "rebuilt" costs a second, a wrong "patched" an afternoon.
"""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from workbench.authoring.problem import hooks_of
from workbench.authoring.reload.call_graph import TwoVersions
from workbench.authoring.reload.memoizing import remembers, root_name
from workbench.authoring.reload.mutable_globals import changed_while_running, written_attributes
from workbench.authoring.reload.symbols import STATEMENTS, Key, file_name

Level = Literal["same", "patched", "cameras", "rebuilt"]

RESET_HOOKS = frozenset(hooks_of("reset"))
STEP_HOOKS = frozenset(hooks_of("step"))
REWARD_HOOKS = frozenset(hooks_of("reward"))
SCORING_HOOKS = REWARD_HOOKS.union(hooks_of("evaluate"), hooks_of("observation"))
"""They run at every step and only look; `BaseEnv.__init__` calls some of them in its first reset."""
CAMERA_HOOKS = frozenset(
    {
        *("_default_sensor_configs", "_default_human_render_camera_configs"),
        "_default_viewer_camera_configs",
    }
)
_RUNS_LATER = RESET_HOOKS | STEP_HOOKS | SCORING_HOOKS
_CAMERAS_THEMSELVES = frozenset(
    (
        "_sensors _human_render_cameras _sensor_configs _human_render_camera_configs sensors "
        "human_render_cameras set_local_pose"
    ).split()
)
_DRAWS = frozenset(
    "rand randn randint randperm uniform normal random choice _batched_episode_rng _episode_rng".split()
)
_MOVES = frozenset("pose get_pose raw_pose qpos get_qpos qvel linear_velocity".split())
_PECULIAR = frozenset(
    (
        "__getattr__ __getattribute__ __setattr__ __delattr__ __init_subclass__ __new__ __class_getitem__ "
        "__set_name__ __slots__ __prepare__ __del__"
    ).split()
)


@dataclass(frozen=True)
class Inherited:
    """What the task's class has of classes that are not in the author's files."""

    names: frozenset[str]
    used_at_build: frozenset[str] = frozenset()
    """Names that such classes use in their own code, BaseEnv's apart: they may call them while they build."""


@dataclass(frozen=True)
class Change:
    """From one version of a task to the next."""

    level: Level
    reason: str
    """For the page: ``only compute_dense_reward changed``."""
    hooks: frozenset[str] = frozenset()
    """Hooks of a task that may run differently now."""

    @property
    def tried_hooks(self) -> frozenset[str]:
        """Those of `hooks` that a look at the present moment does not try."""
        return self.hooks & (RESET_HOOKS | STEP_HOOKS)


class _Heavier(Exception):
    """Why it must be rebuilt."""


def find_change(
    old: Mapping[str, str], new: Mapping[str, str], file: str, class_name: str, inherited: Inherited
) -> Change:
    """Compare two versions of a task: texts by path, of its `file` and the modules beside it.

    Pure: nothing is imported or executed, and nothing that the texts may hold raises.
    """
    if dict(old) == dict(new):
        return Change("same", "nothing changed")
    try:
        return _Comparison(old, new, (file, class_name), inherited).classify()
    except _Heavier as heavier:
        return Change("rebuilt", str(heavier))
    except (SyntaxError, ValueError):  # ValueError: a null byte
        return Change("rebuilt", "the version before cannot be read as Python")
    except RecursionError:
        return Change("rebuilt", "the file is nested too deeply to be compared")


class _Comparison:
    def __init__(
        self, old: Mapping[str, str], new: Mapping[str, str], task: Key, inherited: Inherited
    ) -> None:
        self._both = TwoVersions(old, new)
        self._task, self._inherited = task, inherited

    def classify(self) -> Change:
        family = self._family()
        self._refuse_another_order(family)
        if self._both.changed:
            self._refuse_peculiar(family)
            self._refuse_if_built_of_it(family)
        # These hold for the smallest edit too: the new file's names begin anew with whatever level.
        self._refuse_kept_between_calls(family)
        if not self._both.changed:
            return Change("same", "only comments, docstrings or layout changed")
        affected = self._both.affected()
        self._refuse_remembered(affected)
        hooks = frozenset(key[1].rpartition(".")[2] for key in affected if self._is_hook(key, family))
        seen = self._both.reach(self._both.members(family, CAMERA_HOOKS))
        cameras = any(key in seen for key in self._both.changed)
        if cameras:
            self._refuse_cameras_of_the_moment(seen)
        reason = f"only {_listed([self._say(key) for key in self._both.changed])} changed"
        if not hooks and not cameras:
            reason += ", which no hook uses"
        elif hooks <= RESET_HOOKS and not cameras:
            reason += ": seen from the next reset on"
        return Change("cameras" if cameras else "patched", reason, hooks)

    def _family(self) -> set[Key]:
        """The task's class and those of its bases that are the author's."""
        if self._task not in self._both.old or self._task not in self._both.new:
            raise _Heavier(
                f"the class {self._task[1]} is not defined at the top of the file in both versions"
            )
        found: set[Key] = set()
        waiting = [self._task]
        while waiting:
            key = waiting.pop()
            if key in found:
                continue
            found.add(key)
            for symbol in self._both.of[key]:
                if symbol.kind != "class":
                    raise _Heavier(f"{self._say(key)} is not an ordinary class")
                waiting += [k for k in self._both.mentioned(symbol) if self._both.of[k][0].kind == "class"]
        return found

    def _is_hook(self, key: Key, family: set[Key]) -> bool:
        return key in self._both.members(family, _RUNS_LATER | CAMERA_HOOKS)

    # --- what a live env was built of ---------------------------------------------------------------

    def _build_roots(self, family: set[Key]) -> set[Key]:
        """What may run while the file is imported or the env is built."""
        found: set[Key] = set()
        siblings = self._both.siblings(family)
        for symbol in self._both.symbols:
            if symbol.key in siblings or (symbol.path, symbol.owner) in siblings:
                continue
            foreign_member = symbol.owner is not None and (symbol.path, symbol.owner) not in family
            if symbol.kind in ("statements", "class") or foreign_member:
                # A robot is found by its uid, an enum's members by their place: nobody need name them.
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
        built = self._both.reach(self._build_roots(family))
        for key in self._both.changed:
            if key not in built:
                continue
            by, how = built[key], self._how(key)
            if by is None:
                raise _Heavier(f"{self._say(key)} {how}")
            while (before := built[by]) is not None:
                by = before
            raise _Heavier(f"{self._say(key)} {how}, which {self._say(by)} uses")
        for owner in sorted(family):
            for symbol in self._both.of.get((owner[0], f"{owner[1]}.__init__"), ()):
                if _goes_on_after_super(symbol.nodes):
                    raise _Heavier(f"{symbol.name} goes on after super().__init__(), which has run a reset")
        rewards = self._both.members(family, REWARD_HOOKS)
        for key in self._both.changed:
            if key in rewards and self._how(key) != "changed":
                raise _Heavier(f"{self._say(key)} {self._how(key)}, so the reward mode is chosen anew")

    # --- what cannot be told ------------------------------------------------------------------------

    def _refuse_another_order(self, family: set[Key]) -> None:
        """An enum counts its members by their place, a dataclass its arguments."""
        for key, versions in self._both.of.items():
            if versions[0].kind != "class" or key in family or key in self._both.changed:
                continue
            before, after = (
                [member.name for member in version.values() if (member.path, member.owner) == key]
                for version in (self._both.old, self._both.new)
            )
            if before != after:
                raise _Heavier(f"the members of {self._say(key)} changed, or their order")

    def _refuse_peculiar(self, family: set[Key]) -> None:
        for key in sorted(family):
            for symbol in self._both.of[key]:
                (node,) = symbol.nodes
                assert isinstance(node, ast.ClassDef)
                if node.keywords or getattr(node, "type_params", ()):
                    raise _Heavier(f"the class {symbol.name} is made with arguments")
                for decorator in node.decorator_list:
                    if not ast.unparse(decorator).partition("(")[0].endswith("register_env"):
                        raise _Heavier(f"the class {symbol.name} is decorated with {ast.unparse(decorator)}")
                for name in sorted(_PECULIAR):
                    if (symbol.path, f"{symbol.name}.{name}") in self._both.of:
                        raise _Heavier(f"the class {symbol.name} has {name}")
        for symbol in self._both.symbols:
            # A library's names, whatever they are, reach nothing of the author's.
            from_library = symbol.kind == "import" and symbol.shorts <= self._both.libraries
            if symbol.dynamic is not None and not from_library:
                raise _Heavier(f"{self._say(symbol.key)} uses `{symbol.dynamic}`, which may reach anything")

    # --- what may outlive an exchange of the code -----------------------------------------------------

    def _refuse_kept_between_calls(self, family: set[Key]) -> None:
        found = changed_while_running(self._both.symbols, self._both.libraries)
        if found is not None:
            value, code = found
            raise _Heavier(
                f"{self._say(value.key)} may be changed while the task runs, by {self._say(code.key)}: "
                "it would begin anew with the new file"
            )
        running = self._both.reach(self._both.members(family, _RUNS_LATER))
        for key, by in running.items():
            if by is not None and key not in family and self._both.of[key][0].kind == "class":
                raise _Heavier(
                    f"{self._say(by)} uses the class {self._say(key)}, of which there may be objects"
                )

    def _refuse_remembered(self, affected: set[Key]) -> None:
        libraries = self._both.libraries
        for key in self._both.reach(affected):
            for symbol in self._both.of[key]:
                if symbol.kind != "function":
                    continue
                for node in symbol.nodes:
                    kept = remembers(node, libraries)
                    if kept is not None:
                        raise _Heavier(f"{self._say(key)} may keep what the old version computed ({kept})")
        still_read = {name for symbol in self._both.new.values() for name in symbol.mentions}
        for key in self._both.changed:
            before, after = self._both.old.get(key), self._both.new.get(key)
            lost = written_attributes(before) - written_attributes(after)
            for name in sorted(lost & still_read):
                raise _Heavier(f"{self._say(key)} no longer writes {name}, which is still read")

    def _refuse_cameras_of_the_moment(self, seen: Collection[Key]) -> None:
        """Cameras that are made now must be those that would have been made when the scene was."""
        for symbol in self._both.symbols:
            said = self._say(symbol.key)
            if symbol.key not in seen:
                for name in sorted(symbol.mentions & _CAMERAS_THEMSELVES):
                    raise _Heavier(f"{said} uses {name}, so cameras are not as configured")
                continue
            for name in sorted(symbol.mentions & _DRAWS):
                raise _Heavier(f"{said} uses {name}: the cameras would be drawn anew")
            for node in (node for part in symbol.nodes for node in ast.walk(part)):
                moves = isinstance(node, ast.Attribute) and node.attr in _MOVES
                if moves and root_name(node) == "self":
                    raise _Heavier(f"{said} looks where something is when the scene is built")

    # --- words --------------------------------------------------------------------------------------

    def _how(self, key: Key) -> str:
        old, new = self._both.old, self._both.new
        return "is new" if key not in old else "is gone" if key not in new else "changed"

    def _say(self, key: Key) -> str:
        path, name = key
        if name.endswith(STATEMENTS):
            within = name.removesuffix(STATEMENTS).rstrip(".")
            return f"a statement at the top of {within or file_name(path)}"
        if path == self._task[0]:
            return name.removeprefix(f"{self._task[1]}.")
        return f"{name} of {file_name(path)}"


def _goes_on_after_super(nodes: Iterable[ast.AST]) -> bool:
    """Whether an ``__init__`` does more than set constants once BaseEnv's has built and reset the env."""
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


def _listed(names: list[str]) -> str:
    if len(names) > 4:
        return f"{', '.join(names[:3])} and {len(names) - 3} more"
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
