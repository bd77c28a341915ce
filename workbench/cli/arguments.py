"""Command line arguments that several commands share, and their conversion to options."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import tyro

from workbench.envs.gpu_rules import DEGREES, Degree
from workbench.machine.files import real_path
from workbench.planning.options import PlanArguments, PlanOptions

if TYPE_CHECKING:
    from workbench.task.description import TaskOptions

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
"""Degree of all rules. None, which cannot be given on the command line, keeps each rule's own degree."""

Task = Annotated[str, tyro.conf.Positional]
"""A task file, ``file.py:ClassName``, ``package.module:ClassName``, or a registered env id such as ``PickCube-v1``."""
Imports = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="import")]


@dataclass(frozen=True)
class PageArguments:
    """Where a page is served, and to whom.

    Args:
        host: address to listen on; any address other than localhost needs the token.
        port: port of the page; 0 picks a free one.
        socket: listen on a Unix socket at this path instead, for shared machines: only you can connect, with the
            printed ssh command.
        token: require the token of the printed address (--no-token: localhost only).
    """

    host: str = "127.0.0.1"
    port: int = 8080
    socket: Path | None = None
    token: bool = True


@dataclass(frozen=True)
class JobArguments:
    """Where a job runs, and where its results are kept.

    Args:
        workers: number of processes, each with its own envs; the results are the same with any number.
        cluster: run the workers on Ray: the address of a cluster; local to start one on this machine that ends with the
            job; or auto for a running cluster if there is one, else local. Needs maniskill-workbench[cluster].
        cpus_per_worker: CPU cores for each worker on a cluster.
        gpus_per_worker: GPUs, or fractions of one, for each worker on a cluster.
        job: file that keeps the results as they arrive. If it already holds results of the same job, the job resumes.
        shard: run only one part of the job, as in 3/64 for the third of 64 parts; workbench merge joins them.
            Without --job the results are kept in a file named after the part.
    """

    workers: int | None = None
    cluster: str | None = None
    cpus_per_worker: float = 1
    gpus_per_worker: float = 0
    job: Path | None = None
    shard: str | None = None


ONE_WORKER = JobArguments(workers=1)
_OLD_NAMES = {"--envs-per-worker": "--num-envs"}
"""New name of each option that was renamed in this release; the next release drops the old names."""


def with_new_names(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Replace old option names; returns the new arguments, and a notice for each old name."""
    given, notices = list(arguments), dict[str, str]()
    for place, one in enumerate(given):
        name, equals, value = one.partition("=")
        if one == "--":
            break
        if (new := _OLD_NAMES.get(name.replace("_", "-"))) is not None:
            given[place] = f"{new}{equals}{value}"
            notices[name] = f"{name} is called {new} now; the next release drops the old name"
    return given, list(notices.values())


@dataclass(frozen=True)
class EnvArguments:
    """How the envs of a task are made.

    Args:
        num_envs: environments that run at once.
        backend: cpu (batched), gpu (ManiSkill's GPU simulation), or auto (cpu, as no gpu test has passed yet).
        rules: what happens when the task breaks a rule of GPU simulation: stop, warn, or off (no checks). By
            default, a breach that makes every later number wrong stops the task; others warn.
        imports: a module that registers the task's id, such as lab.tasks, imported in the process that runs the task;
            repeatable.
        seed: seed of the first env or episode; the following ones count up.
        env: more arguments of the task class, as name=value (value in JSON, or text); repeatable.
    """

    num_envs: int = 16
    backend: Backend = "auto"
    rules: Rules = None
    imports: Imports = ()
    seed: int = 0
    env: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()

    def options(self) -> TaskOptions:
        """Convert to options. Raises ValueError with a message that names the argument."""
        return _options(self.num_envs, self.backend, self.rules, self.imports, self.seed, self.env)


@dataclass(frozen=True)
class EpisodeArguments:
    """How the envs of each worker are made.

    Args:
        num_envs: environments that run at once in each worker. A policy's results may differ in the last bits with this
            value (only).
        backend: cpu (batched), gpu (ManiSkill's GPU simulation), or auto (cpu, as no gpu test has passed yet).
        rules: what happens when the task breaks a rule of GPU simulation: stop, warn, or off (no checks). By
            default, a breach that makes every later number wrong stops the task; others warn.
        imports: a module that registers the task's id, such as lab.tasks, imported in the process that runs the task;
            repeatable.
        seed: seed of the first episode; the following ones count up.
        env: more arguments of the task class, as name=value (value in JSON, or text); repeatable.
    """

    num_envs: int = 4
    backend: Backend = "auto"
    rules: Rules = None
    imports: Imports = ()
    seed: int = 0
    env: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()

    def options(self) -> TaskOptions:
        return _options(self.num_envs, self.backend, self.rules, self.imports, self.seed, self.env)


@dataclass(frozen=True)
class RescoreArguments:
    """How the envs of each worker are made.

    Args:
        num_envs: environments that run at once in each worker.
        backend: cpu (batched), gpu (ManiSkill's GPU simulation), or auto (cpu, as no gpu test has passed yet).
        rules: what happens when the task breaks a rule of GPU simulation: stop, warn, or off (no checks). By
            default, a breach that makes every later number wrong stops the task; others warn.
        imports: a module that registers the task's id, such as lab.tasks, imported in the process that runs the task;
            repeatable.
    """

    num_envs: int = 16
    backend: Backend = "auto"
    rules: Rules = None
    imports: Imports = ()

    def options(self) -> TaskOptions:
        return _options(self.num_envs, self.backend, self.rules, self.imports)


@dataclass(frozen=True)
class CheckArguments:
    """Envs and seeds that a task is checked on.

    Args:
        num_envs: environments that run at once in each worker.
        seeds: number of seeds to try. Rules that compare whole batches use one seed for each env.
        seed: the first seed; the following ones count up.
        imports: a module that registers the task's id, such as lab.tasks, imported in the process that runs the task;
            repeatable.
        env: more arguments of the task class, as name=value (value in JSON, or text); repeatable.
    """

    num_envs: int = 8
    seeds: int = 32
    seed: int = 0
    imports: Imports = ()
    env: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()

    def options(self) -> TaskOptions:
        return _options(self.num_envs, "cpu", None, self.imports, self.seed, self.env)


def _options(
    num_envs: int,
    backend: Backend,
    rules: Rules,
    imports: Sequence[str],
    seed: int = 0,
    env: Sequence[str] = (),
) -> TaskOptions:
    from workbench.task.description import TaskOptions

    if not 1 <= num_envs <= 4096:
        raise ValueError(f"--num-envs must be from 1 to 4096, not {num_envs}")
    if not 0 <= seed < 2**31:
        raise ValueError(f"--seed must be from 0 to {2**31 - 1}, not {seed}")
    kwargs = dict(_env_argument(pair) for pair in env)
    return TaskOptions(num_envs, backend, seed, kwargs, rules=rules, imports=imported(imports))


def plan_options(plan: PlanArguments) -> PlanOptions:
    """Validate the arguments. Raises ValueError with a message that names the argument."""
    try:
        return PlanOptions(**vars(plan))
    except ValueError as error:
        raise ValueError(f"--{error}") from error


def separated(names: Sequence[str]) -> tuple[str, ...]:
    """Split the values of a repeatable option into names, at commas and white space."""
    return tuple(name for one in names for name in one.replace(",", " ").split())


def imported(names: Sequence[str]) -> tuple[str, ...]:
    """Check the module names of ``--import`` without importing them; returns them. Raises ValueError."""
    from workbench.task.reference import find_module, is_module_name, not_found_text

    for name in names:
        if not is_module_name(name):
            raise ValueError(f"--import takes the name of a module, as in --import lab.tasks; got {name!r}")
        if find_module(name) is None:
            raise ValueError(f"--import {name}: {not_found_text(name)}")
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
    """Parse ``--history``: ``256MB``, ``1.5 GB`` or a plain number of bytes. Returns bytes. Raises
    ValueError."""
    from workbench.live.process.memory_limit import size_in_bytes

    size = size_in_bytes(text)
    if size is None or not 2**20 <= size <= 2**40:
        raise ValueError(f"--history takes a size from 1MB to 1TB, such as 256MB or 2GB; got {text!r}")
    return int(size)


def why_unwritable(*files: Path | None) -> str | None:
    """Create the folders of these files. Returns why a file cannot be written; None if all can."""
    for file in files:
        if file is None:
            continue
        folder = real_path(file).parent
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            return f"{file} cannot be written: the folder {folder} cannot be made ({error.strerror})"
        if file.is_dir():
            return f"{file} is a folder: name a file in it"
        if not os.access(folder, os.W_OK):
            return f"{file} cannot be written: you may not write into {folder}"
    return None
