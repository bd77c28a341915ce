"""In the worker: what the camera hooks give with another text of the author's files, and no trace left of it."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from workbench.authoring.camera_source.cameras import Ran
from workbench.authoring.camera_source.run_hooks import run_hooks
from workbench.authoring.load import LoadedTask, load_task, take_back
from workbench.authoring.reference import class_beside
from workbench.authoring.source.names import Project
from workbench.authoring.source.text import plain_line_ends
from workbench.core import seams
from workbench.core.exchange import put_class, undone
from workbench.session.open_task import OpenedTask, blamed
from workbench.session.questions import RunCameras


def run_cameras(opened: OpenedTask, question: RunCameras) -> Ran:
    """The hooks are called on the live env, which is given the new text's classes meanwhile.

    Raises:
        TaskError: the text does not load, or a hook fails.
    """
    file, env, found = opened.loaded.file, opened.env.env, list[Ran]()
    if file is None:
        raise ValueError("the task has no file")
    loaded = load_task(class_beside(question.task, file, opened.loaded.chosen), source=question.texts)
    try:
        with blamed("build", loaded, opened.env), _being(env, opened.loaded, loaded, question.texts):
            undone(env, lambda: found.append(run_hooks(env, question.texts)))
    finally:
        take_back(loaded)
    return found[0]


@contextmanager
def _being(env: Any, before: LoadedTask, after: LoadedTask, texts: Mapping[str, str]) -> Iterator[None]:
    """Within this the env and its robots are of the new text's classes, with what their constructors set in it."""
    agents = [] if env.agent is None else getattr(env.agent, "agents", [env.agent])
    classes = [(agent, type(agent)) for agent in agents]
    task, kept = seams.task_class(env), [(owner, dict(vars(owner))) for owner in (env, *agents)]
    try:
        put_class(env, after.cls)
        for agent, cls in classes:
            module = sys.modules.get(cls.__module__)
            if getattr(module, "__file__", None) in texts:
                agent.__class__ = getattr(module, cls.__qualname__, cls)
        for owner, _ in kept:
            for name, value in _set_otherwise(before.source, texts, owner).items():
                vars(owner)[name] = value
        yield
    finally:
        put_class(env, task)
        for agent, cls in classes:
            agent.__class__ = cls
        for owner, names in kept:
            vars(owner).clear()
            vars(owner).update(names)


def _set_otherwise(before: Mapping[str, str], after: Mapping[str, str], owner: Any) -> dict[str, Any]:
    """What the new text sets an object's attributes to, of those that the old one sets to something else.

    A live env has its attributes from the text that built it, and a camera may stand where one of them says.
    """
    old, new = Project(before), Project(after)
    edited = [path for path, text in after.items() if before.get(path) != plain_line_ends(text)]
    named = {n.attr for path in edited for n in new.file(path).nodes if isinstance(n, ast.Attribute)}
    found: dict[str, Any] = {}
    for name in named & vars(owner).keys():
        was, stores = old.attribute_stores(name), new.attribute_stores(name)
        if len(was) != 1 or len(stores) != 1 or was[0].value is None or stores[0].value is None:
            continue
        if ast.dump(was[0].value) != ast.dump(stores[0].value):
            module = next(
                m for m in list(sys.modules.values()) if getattr(m, "__file__", None) == stores[0].file.path
            )
            code = compile(ast.Expression(stores[0].value), stores[0].file.path, "eval")
            found[name] = eval(code, vars(module), {"self": owner})
    return found
