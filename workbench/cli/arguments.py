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
"""None is each rule's own degree; the command line has no word for it."""

Task = Annotated[str, tyro.conf.Positional]
"""A task file, ``file.py:ClassName``, ``package.module:ClassName``, or a registered env id such as ``PickCube-v1``."""
Imports = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="import")]


@dataclass(frozen=True)
class PageArguments:
    """Where a page is served, and to whom.

    Args:
        host: address to listen on; anything but this machine's own needs the token.
        port: port of the page; 0 takes any free one.
        socket: listen on a Unix socket with this path instead, for machines that others use too: only you can
            connect, by the ssh line that is printed.
        token: ask for the token of the printed address (--no-token: this machine only).
    """

    host: str = "127.0.0.1"
    port: int = 8080
    socket: Path | None = None
    token: bool = True


@dataclass(frozen=True)
class JobArguments:
    """Where a job runs, and what is kept of it.

    Args:
        workers: processes, each with envs of its own; what comes out is the same with any number.
        cluster: run the workers on Ray: the address of a cluster; local for one that is started on this machine and ends
            with the job; or auto, which takes one that is there, else does that. Needs maniskill-workbench[cluster].
        cpus_per_worker: on a cluster, the cores that each worker is given.
        gpus_per_worker: likewise, the GPUs, or parts of one.
        job: a file that keeps the results as they come. Where it has some of this very job, the job goes on after them.
        shard: do only a part of the job, as in 3/64 for the third of 64; workbench merge puts the parts together. Without
            --job the results are kept in a file that is named after the part.
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
    """The arguments with the new names of options, and a sentence for each old one."""
    given, told = list(arguments), dict[str, str]()
    for place, one in enumerate(given):
        name, equals, value = one.partition("=")
        if one == "--":
            break
        if (new := _OLD_NAMES.get(name.replace("_", "-"))) is not None:
            given[place] = f"{new}{equals}{value}"
            told[name] = f"{name} is called {new} now; the next release drops the old name"
    return given, list(told.values())


@dataclass(frozen=True)
class EnvArguments:
    """How the envs of a task are made.

    Args:
        num_envs: environments that run at once.
        backend: cpu (batched), gpu (ManiSkill's GPU simulation), or auto: cpu, while no test of gpu has passed anywhere.
        rules: what happens where the task breaks a rule of GPU simulation: stop, warn, or off to check none. If not
            given, what writes over the state of other envs stops, all else is a warning.
        imports: a module that registers the task's id, such as lab.tasks, imported in the process that runs the task;
            repeatable.
        seed: seed of the first env or episode; each further one counts up.
        env: further arguments of the task class, as name=value (value in JSON, or text); repeatable.
    """

    num_envs: int = 16
    backend: Backend = "auto"
    rules: Rules = None
    imports: Imports = ()
    seed: int = 0
    env: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()

    def options(self) -> TaskOptions:
        """Raises ValueError with a message that names the argument, as all functions here."""
        return _options(self.num_envs, self.backend, self.rules, self.imports, self.seed, self.env)


@dataclass(frozen=True)
class EpisodeArguments:
    """How the envs of each worker are made.

    Args:
        num_envs: environments that run at once in each worker. The numbers of a policy depend on it by their last bits,
            and on nothing else of how the job runs.
        backend: cpu (batched), gpu (ManiSkill's GPU simulation), or auto: cpu, while no test of gpu has passed anywhere.
        rules: what happens where the task breaks a rule of GPU simulation: stop, warn, or off to check none. If not
            given, what writes over the state of other envs stops, all else is a warning.
        imports: a module that registers the task's id, such as lab.tasks, imported in the process that runs the task;
            repeatable.
        seed: seed of the first episode; each further one counts up.
        env: further arguments of the task class, as name=value (value in JSON, or text); repeatable.
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
        backend: cpu (batched), gpu (ManiSkill's GPU simulation), or auto: cpu, while no test of gpu has passed anywhere.
        rules: what happens where the task breaks a rule of GPU simulation: stop, warn, or off to check none. If not
            given, what writes over the state of other envs stops, all else is a warning.
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
    """On what a task is checked.

    Args:
        num_envs: environments that run at once in each worker.
        seeds: how many seeds are tried. What compares whole batches takes one for each env.
        seed: the first of them; each further one counts up.
        imports: a module that registers the task's id, such as lab.tasks, imported in the process that runs the task;
            repeatable.
        env: further arguments of the task class, as name=value (value in JSON, or text); repeatable.
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
    """Raises ValueError with a message that names the argument."""
    try:
        return PlanOptions(**vars(plan))
    except ValueError as error:
        raise ValueError(f"--{error}") from error


def separated(names: Sequence[str]) -> tuple[str, ...]:
    """The names of an option that is given several times, or once with commas."""
    return tuple(name for one in names for name in one.replace(",", " ").split())


def imported(names: Sequence[str]) -> tuple[str, ...]:
    """The modules of ``--import``, checked and not imported. Raises ValueError."""
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
    """Bytes of ``--history``: ``256MB``, ``1.5 GB`` or a plain number. Raises ValueError."""
    from workbench.live.process.memory_limit import size_in_bytes

    size = size_in_bytes(text)
    if size is None or not 2**20 <= size <= 2**40:
        raise ValueError(f"--history takes a size from 1MB on, such as 256MB or 2GB; got {text!r}")
    return int(size)


def why_unwritable(*files: Path | None) -> str | None:
    """Make the folders of these files. Returns why one of the files cannot be written; None if each can."""
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
