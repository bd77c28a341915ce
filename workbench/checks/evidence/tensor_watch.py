"""Watches what the author's lines do with tensors: on which device each would be with a GPU, and copies to
the host."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from torch.overrides import TorchFunctionMode, _get_current_function_mode_stack
from torch.utils._device import DeviceContext

from workbench.envs.broken_rule import Place

NUM_ENVS = 5
"""Number of envs: no vector that a task iterates has this length (positions have 3, quaternions 4, poses 7)."""

_TORCH = f"{Path(torch.__file__).parent}/"
_FACTORIES: frozenset[Any] = frozenset(
    {
        torch.arange, torch.as_tensor, torch.asarray, torch.empty, torch.eye, torch.full, torch.linspace,
        torch.logspace, torch.ones, torch.rand, torch.randint, torch.randn, torch.randperm, torch.scalar_tensor, torch.tensor,
        torch.tril_indices, torch.triu_indices, torch.zeros,
    }
)  # fmt: skip
_MOVES = {"to", "cpu", "cuda", "type_as"}
_MIXES = {"copy_", "type_as", "to", "expand_as", "view_as", "reshape_as", "set_", "is_set_to"}
"""Operations that accept tensors of two devices."""
_COPIES = {
    "item": ".item()", "cpu": ".cpu()", "numpy": ".numpy()", "tolist": ".tolist()", "__bool__": "if tensor:",
    "__float__": "float(tensor)", "__int__": "int(tensor)", "__index__": "tensor as a Python number",
    "__array__": "np.array(tensor)", "equal": "torch.equal()", "allclose": "torch.allclose()",
}  # fmt: skip
_PASSED_THROUGH = ("mani_skill.utils.common", "mani_skill.utils.structs.pose")
"""Modules whose copies count for the line that calls them: ``pose.sp``, ``common.to_numpy(x)``."""
_STATE = "_workbench_device"
_OWN = "own"
"""State of a tensor on the env's device. The state of a tensor that would stay on the host is the `Place` of
the line that made it. A tensor of unknown origin (``torch.Tensor([1])``) has no state."""
_HOST = torch.device("cpu", 0)
"""What ``tensor.device`` gives for a host tensor, so that a tensor that is made on the device of a host
tensor counts as a host tensor too. Unlike the env's device, it has an index."""


@dataclass(frozen=True)
class Mix:
    """A host tensor and a tensor on the env's device in one operation."""

    made: Place
    """Line that made the host tensor."""
    operation: str


@dataclass
class TensorUses:
    """Uses of tensors in the author's lines."""

    num_envs: int = NUM_ENVS
    steps: int = 0
    """Number of control steps that were watched."""
    copies: Counter[Place] = field(default_factory=Counter)
    """Number of copies to the host in these steps, by line."""
    written: dict[Place, str] = field(default_factory=dict)
    """Text of the copy, such as ``.item()``, by line."""
    iterated: Counter[Place] = field(default_factory=Counter)
    """Number of iterations over the rows of a tensor of `NUM_ENVS` rows in these steps, by line."""
    mixes: dict[Place, Mix] = field(default_factory=dict)
    """The first mix of each line, including mixes while the env was built and reset."""


class TensorWatch(TorchFunctionMode):
    """Context that fills `uses`.

    On the CPU all tensors are on one device. The watch follows which of them would be on the host with a GPU: a tensor that is
    made without a device is on the host until it is moved.
    """

    def __init__(self, files: Collection[str], num_envs: int = NUM_ENVS) -> None:
        """
        Args:
            files: paths of the author's files.
            num_envs: number of envs that are watched; loops over envs are seen only if it is `NUM_ENVS`.
        """
        super().__init__()
        self.uses = TensorUses(num_envs)
        self._files = frozenset(files)
        self._in_step = False

    @contextmanager
    def step(self) -> Iterator[None]:
        """Context of one control step."""
        self._in_step = True
        try:
            yield
        finally:
            self._in_step = False
            self.uses.steps += 1

    def __enter__(self) -> Any:
        # torch.from_numpy is the only function that makes a tensor without calling a TorchFunctionMode.
        self._from_numpy = torch.from_numpy
        torch.from_numpy = self._made_from_numpy
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        torch.from_numpy = self._from_numpy
        super().__exit__(*error)

    def _made_from_numpy(self, array: Any) -> torch.Tensor:
        made = self._from_numpy(array)
        frame = sys._getframe(1)
        if frame.f_code.co_filename in self._files:
            setattr(made, _STATE, _place(frame))
        return made

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = getattr(func, "__name__", "")
        tensors = list(_tensors((*args, *kwargs.values())))
        if name == "__get__" and len(tensors) == 1:
            return self._attribute(func(*args, **kwargs), tensors[0])
        frame = _caller(sys._getframe(1))
        hosts = [each for each in tensors if _is_host(each)]
        author = frame is not None and frame.f_code.co_filename in self._files
        if self._in_step:
            self._note_step(name, tensors, hosts, frame)
        state = self._state(func, name, args, kwargs, tensors, hosts, frame, author)
        result = func(*args, **kwargs)
        for made in _tensors((result,)):
            if any(made is each for each in tensors):
                if name not in _MOVES or getattr(made, _STATE, _OWN) == state:
                    continue
                # If there is nothing to move, torch returns the given tensor, which must keep its state. So
                # the result becomes a view of it.
                result = made = made.view(made.shape)
            if state is None:
                continue
            setattr(made, _STATE, state)
        return result

    def _attribute(self, value: Any, tensor: torch.Tensor) -> Any:
        if isinstance(value, torch.Tensor):
            state = getattr(tensor, _STATE, None)
            if state is not None:
                setattr(value, _STATE, state)
        elif isinstance(value, torch.device) and _is_host(tensor):
            return _HOST
        return value

    def _state(
        self,
        func: Any,
        name: str,
        args: Any,
        kwargs: Any,
        tensors: list[torch.Tensor],
        hosts: list[torch.Tensor],
        frame: FrameType | None,
        author: bool,
    ) -> Any:
        """State of the result of an operation."""
        device = _device_of(args, kwargs) if name in ("to", "new_tensor") or "device" in kwargs else None
        follows = frame is not None and (
            author or frame.f_globals.get("__name__", "").startswith("mani_skill.")
        )
        if not tensors:
            stays = follows and func in _FACTORIES and device != "own" and not _in_device_context()
            return _place_of([], frame) if stays else _OWN
        if device is not None:
            return _OWN if device == "own" else _place_of(hosts, frame)
        if name == "cpu":
            return _place_of(hosts, frame) if follows else _OWN
        if name == "type_as" and len(tensors) == 2:
            return getattr(tensors[1], _STATE, None)
        if name == "cuda":
            return _OWN
        own = [each for each in tensors if not _is_host(each)]
        if not hosts:
            known = any(hasattr(each, _STATE) for each in tensors)
            return _OWN if known or not author else None
        if not own:
            return getattr(hosts[0], _STATE)
        if author and frame is not None:
            self._note_mix(name, args, hosts, own, frame)
        return _OWN

    def _note_mix(
        self,
        name: str,
        args: Any,
        hosts: list[torch.Tensor],
        own: list[torch.Tensor],
        frame: FrameType,
    ) -> None:
        own = [each for each in own if each.ndim and getattr(each, _STATE, None) == _OWN]
        hosts = [each for each in hosts if each.ndim]
        if not own or not hosts or name in _MIXES:
            return
        if name == "__getitem__" and not _is_host(args[0]):
            return  # an index may come from the host
        if name == "__setitem__":
            # torch copies the value to the target's device, unless the index is a tensor.
            rows = list(_tensors((args[1],)))
            indexed_by_own = _is_host(args[0]) and any(not _is_host(each) and each.ndim for each in rows)
            put = any(each.ndim for each in rows) and isinstance(args[2], torch.Tensor) and args[2].ndim > 0
            if not indexed_by_own and not (put and _is_host(args[0]) != _is_host(args[2])):
                return
        self.uses.mixes.setdefault(_place(frame), Mix(getattr(hosts[0], _STATE), name.strip("_")))

    def _note_step(
        self, name: str, tensors: list[torch.Tensor], hosts: list[torch.Tensor], frame: FrameType | None
    ) -> None:
        if frame is None or hosts:
            return
        if name in _COPIES:
            line: FrameType | None = frame
            while line is not None and line.f_globals.get("__name__") in _PASSED_THROUGH:
                line = line.f_back
            if line is not None and line.f_code.co_filename in self._files:
                self.uses.copies[_place(line)] += 1
                self.uses.written.setdefault(_place(line), _COPIES[name])
        elif name == "unbind" and frame.f_code.co_filename in self._files:
            inner = sys._getframe(2)
            if inner.f_code.co_name == "__iter__" and len(tensors[0]) == self.uses.num_envs == NUM_ENVS:
                self.uses.iterated[_place(frame)] += 1


def _is_host(tensor: torch.Tensor) -> bool:
    return getattr(tensor, _STATE, _OWN) != _OWN


def _place_of(hosts: list[torch.Tensor], frame: FrameType | None) -> Any:
    """The line that made the first of `hosts`; without `hosts`, the line of `frame`."""
    return getattr(hosts[0], _STATE) if hosts else _OWN if frame is None else _place(frame)


def _place(frame: FrameType) -> Place:
    outer = frame
    while outer.f_code.co_name.startswith("<") and outer.f_back is not None:  # a comprehension
        outer = outer.f_back
    return frame.f_code.co_filename, frame.f_lineno, outer.f_code.co_name


def _caller(frame: FrameType | None) -> FrameType | None:
    """The first frame outside torch."""
    while frame is not None and frame.f_code.co_filename.startswith(_TORCH):
        frame = frame.f_back
    return frame


def _tensors(values: Iterable[Any]) -> Iterator[torch.Tensor]:
    for value in values:
        if isinstance(value, torch.Tensor):
            yield value
        elif isinstance(value, (tuple, list)):
            yield from _tensors(value)


def _device_of(args: Any, kwargs: Any) -> str | None:
    """The device that the arguments of an operation ask for: ``host`` or ``own``; None if they name no
    device."""
    for value in (*args[1:], *kwargs.values()):
        if isinstance(value, torch.Tensor):
            return "host" if _is_host(value) else "own"
        if isinstance(value, torch.device):
            return "host" if value == _HOST else "own"
        if isinstance(value, str):
            return "host" if value.startswith("cpu") else "own"
    return None


def _in_device_context() -> bool:
    return any(isinstance(mode, DeviceContext) for mode in _get_current_function_mode_stack())
