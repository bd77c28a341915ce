"""Arguments that several commands turn into the same things: how a task is made, and sizes of memory.

Raises ValueError throughout, with a sentence that names the argument.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import tyro

from workbench.core.rules import DEGREES, Degree

if TYPE_CHECKING:
    from workbench.session.messages import TaskOptions

Backend = Literal["auto", "cpu", "gpu"]
Rules = Annotated[
    Degree | None,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(DEGREES)}}}",
        instance_from_str=lambda given: cast(Degree, given[0]),
        is_instance=lambda value: value is None or value in DEGREES,
        str_from_instance=lambda value: [str(value)],
        choices=DEGREES,
    ),
]
"""None is each rule's own degree, and no word for the command line."""


def task_options(
    num_envs: int,
    backend: Backend,
    seed: int,
    env: Sequence[str],
    rules: Rules = None,
    imports: Sequence[str] = (),
) -> TaskOptions:
    """Of ``--num-envs``, ``--backend``, ``--seed``, each ``--env``, ``--rules`` and each ``--import``."""
    from workbench.session.messages import TaskOptions

    if not 1 <= num_envs <= 4096:
        raise ValueError(f"--num-envs must be from 1 to 4096, not {num_envs}")
    if not 0 <= seed < 2**31:
        raise ValueError(f"--seed must be from 0 to {2**31 - 1}, not {seed}")
    return TaskOptions(
        num_envs, backend, seed, dict(_env_argument(pair) for pair in env), rules, imported(imports)
    )


def imported(names: Sequence[str]) -> tuple[str, ...]:
    """Of each ``--import``: modules, which are not imported here."""
    from workbench.authoring.named_modules import find_module, is_module_name, not_found

    for name in names:
        if not is_module_name(name):
            raise ValueError(f"--import takes the name of a module, as in --import lab.tasks; got {name!r}")
        if find_module(name) is None:
            raise ValueError(f"--import {name}: {not_found(name)}")
    return tuple(names)


def _env_argument(pair: str) -> tuple[str, Any]:
    name, equals, value = pair.partition("=")
    if not equals or not name.isidentifier():
        raise ValueError(f"--env takes name=value, as in --env robot_uids=fetch; got {pair!r}")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def history_bytes(text: str) -> int:
    """Of ``--history``: ``256MB``, ``1.5 GB`` or a plain number."""
    from workbench.session.memory_limit import size_in_bytes

    size = size_in_bytes(text)
    if size is None or not 2**20 <= size <= 2**40:
        raise ValueError(f"--history takes a size from 1MB on, such as 256MB or 2GB; got {text!r}")
    return int(size)
