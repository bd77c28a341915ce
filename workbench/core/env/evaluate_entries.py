"""Splits what ``evaluate()`` returned into rows per env and other entries; checks what hooks return."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from mani_skill.utils.structs.pose import Pose
from numpy.typing import NDArray

from workbench.core.env.step_result import OtherEntry

FLAGS = ("success", "fail")
MOST_LETTERS = 400
"""Of the text of a value."""
MOST_NUMBERS = 1024
"""Of a value of the whole batch that is kept as numbers; of a larger one only type and shape are told."""
MOST_ENTRIES = 1000
"""Leaves; of more only the number is told."""
_MOST_NAME = 200
_MOST_READ = 1 << 26
"""Numbers of one value; a sparse tensor may say that it has more than there is memory."""
_NOT_EVALUATED = ("elapsed_steps", "reconfigure")
"""What ManiSkill itself puts into ``info``."""
_REAL = "biuf"
_PLAIN = {torch.bool, torch.float32, torch.float64, torch.int32, torch.int64, torch.uint8}
"""Types that numpy has too."""
_DEEPEST = 16
_NOT_SHOWN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters, and halves of surrogate pairs, which no file and no browser takes."""
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")
"""In a default repr: another in every run."""

_short = reprlib.Repr()
_short.maxlevel = 4
_short.maxdict = _short.maxlist = _short.maxtuple = _short.maxset = _short.maxfrozenset = 20
_short.maxdeque = _short.maxarray = 20
_short.maxstring = _short.maxlong = _short.maxother = MOST_LETTERS


def split_entries(info: Mapping[Any, Any], num_envs: int) -> tuple[dict[str, NDArray], dict[str, OtherEntry]]:
    """The entries of `info` that are real numbers with a row for each env, (N, ...) each; and the others. All are copies.

    ManiSkill reads ``success`` and ``fail`` alone and passes the rest on: None, a string, ``progress.mean()``, an object. A
    tensor, array or list has rows if its first dimension is N: with one env, shape (1,) has and () has not, except for
    ``success`` and ``fail``, as in ManiSkill. A nested dict is split into its leaves, named by their keys.
    """
    columns: dict[str, NDArray] = {}
    others: dict[str, OtherEntry] = {}
    left_out = 0
    for path, value in leaves(info):
        if path in _NOT_EVALUATED:
            continue
        if len(columns) + len(others) >= MOST_ENTRIES:
            left_out += 1
            continue
        name = _name(path, columns, others)
        array = _array(value)
        if array is None:
            others[name] = _other(value, num_envs)
        elif array.ndim and len(array) == num_envs:
            columns[name] = array
        elif name in FLAGS:
            # ManiSkill takes a single truth for all envs; the page asks for a row each.
            columns[name] = np.broadcast_to(array, (num_envs, *array.shape)).copy()
        else:
            others[name] = _numbers(value, array)
    if left_out:
        others[_name("…", columns, others)] = OtherEntry("entries", (f"{left_out} more",), whole=False)
    return columns, others


def leaves(value: Any, path: str = "", above: tuple[int, ...] = ()) -> Iterator[tuple[str, Any]]:
    """The leaves of nested dicts, each with the keys that lead to it, joined by ``/``; a dict without keys, or within
    itself, is one."""
    # A dict that holds itself has no last leaf.
    if (
        not isinstance(value, Mapping)
        or len(above) > _DEEPEST
        or id(value) in above[1:]
        or (above and not value)
    ):
        yield path, value
        return
    for key, held in value.items():
        yield from leaves(held, f"{path}/{_key(key)}" if path else _key(key), (*above, id(value)))


def flat_entries(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """The `leaves` that are no dicts: none of an empty one; what is no dict itself is one with the name `path`."""
    return ((name, held) for name, held in leaves(value, path) if not isinstance(held, Mapping))


def _key(key: Any) -> str:
    return (key if type(key) is str else _text(key)[0]) or "''"


def _name(path: str, columns: Mapping[str, Any], others: Mapping[str, Any]) -> str:
    """`path` as a file can hold it: ``a/b`` may be a key, and ``b`` of the dict ``a`` as well."""
    name = plain = _clean_name(path)
    number = 2
    while name in columns or name in others:
        name = f"{plain} ({number})"
        number += 1
    return name


@lru_cache(maxsize=4096)
def _clean_name(path: str) -> str:
    name = clean_text(path)
    return name if len(name) <= _MOST_NAME else name[: _MOST_NAME - 1] + "…"


def _array(value: Any) -> NDArray | None:
    """`value` as booleans or real numbers; None where it is none, or is not all there to be read."""
    if isinstance(value, torch.Tensor):
        return _of_tensor(value)
    if isinstance(value, np.ndarray):
        return value.copy() if value.dtype.kind in _REAL else None
    if isinstance(value, (bool, int, float, np.bool_, np.integer, np.floating)):
        found = np.asarray(value)
        return found if found.dtype.kind in _REAL else None  # an int of more than 64 bits is an object
    if isinstance(value, (list, tuple)) and value:
        return _of_list(value)
    if isinstance(value, Pose):
        return _of_tensor(value.raw_pose)
    return None


def _of_tensor(value: torch.Tensor) -> NDArray | None:
    if value.dtype in _PLAIN and value.layout is torch.strided and value.device.type == "cpu":
        # Nearly always; the general way takes three times as long.
        found = value.detach().numpy() if value.requires_grad else value.numpy()
        return found.copy()
    if value.is_complex() or value.numel() > _MOST_READ:
        return None
    try:
        if value.layout is not torch.strided:
            value = value.to_dense()
        if value.is_floating_point() and value.dtype not in (torch.float16, torch.float32, torch.float64):
            value = value.float()  # numpy has no bfloat16
        found = value.numpy(force=True)
    except (RuntimeError, TypeError, NotImplementedError):
        return None  # of the meta device, say: there is nothing to be read
    return found.copy()


def _of_list(value: list[Any] | tuple[Any, ...]) -> NDArray | None:
    if len(value) > _MOST_READ or any(isinstance(item, (str, bytes, Mapping)) for item in value):
        return None
    rows: list[Any] = [_of_tensor(item) if isinstance(item, torch.Tensor) else item for item in value]
    if any(row is None for row in rows):
        return None
    try:
        found = np.array(rows)
    except (ValueError, TypeError, OverflowError):  # rows of several lengths
        return None
    return found if found.dtype.kind in _REAL else None


def _numbers(value: Any, array: NDArray) -> OtherEntry:
    what = type_text(value)
    if array.size == 0:
        return OtherEntry(what, ("[]",))
    if array.size > MOST_NUMBERS:
        return OtherEntry(what, (f"{array.size:,} numbers",), whole=False)
    return OtherEntry(what, numbers=array if array.flags.owndata else array.copy())


def _other(value: Any, num_envs: int) -> OtherEntry:
    rows = _rows_of(value)
    if rows is not None and len(rows) == num_envs:
        texts, whole = zip(*map(_text, rows), strict=True)
        return OtherEntry(type_text(value), texts, per_env=True, whole=all(whole))
    text, whole = _text(value)
    return OtherEntry(type_text(value), (text,), whole=whole)


def _rows_of(value: Any) -> list[Any] | tuple[Any, ...] | NDArray | None:
    """What there is one of for each env, if there are N of them."""
    if isinstance(value, (list, tuple)):
        return value
    if isinstance(value, torch.Tensor) and value.is_complex():
        value = value.resolve_conj().numpy(force=True)
    return value if isinstance(value, np.ndarray) and value.ndim else None


def type_text(value: Any) -> str:
    """The type of a value, with the shape of an array, for a person."""
    if isinstance(value, torch.Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} tensor of shape {tuple(value.shape)}"
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if isinstance(shape, tuple) and dtype is not None:
        return f"{type(value).__module__.partition('.')[0]} {dtype} array of shape {shape}"
    return "None" if value is None else type(value).__qualname__


def _text(value: Any) -> tuple[str, bool]:
    """`value` for a person, and whether that is all of it."""
    if isinstance(value, np.generic):
        value = str(value)  # its repr names numpy, and Python's number has digits that it has not
    if isinstance(value, str):
        said = str.__str__(value)
    else:
        said = safe_repr(value)
    if len(said) > MOST_LETTERS:
        return clean_text(said[: MOST_LETTERS - 1]) + "…", False
    return clean_text(said), isinstance(value, str) or "..." not in said


def safe_repr(value: object) -> str:
    """A repr of bounded length, also of an object whose own raises."""
    try:
        if isinstance(value, (list, tuple, dict, set, frozenset)):
            said = _short.repr(value)
        else:
            said = repr(value)
    except Exception as error:  # whatever an author's __repr__ raises: the value is shown all the same
        return f"<{type(value).__qualname__}, whose repr raises {type(error).__name__}>"
    return _ADDRESS.sub("", said)


def clean_text(text: str) -> str:
    """Text that files and browsers take."""
    return _NOT_SHOWN.sub("\ufffd", text)


# --- what is wrong with them -------------------------------------------------------------------------


def wrong_evaluate(evaluate: object, num_envs: int) -> str | None:
    """Said of ``evaluate()``: it must return a dict, in which ``success`` and ``fail`` are bool tensors (N,).

    The other entries may be anything, as in ManiSkill: what has no row for each env is shown as it is (`entries`).
    """
    if not isinstance(evaluate, Mapping):
        return f"returned {_describe(evaluate)}; it must return a dict ({{}} where there is nothing to say)"
    for name in FLAGS:
        value = evaluate.get(name)
        if name in evaluate and not (
            isinstance(value, torch.Tensor) and value.dtype == torch.bool and _a_row_each(value, num_envs)
        ):
            return f"returned {name!r} as {_describe(value)}; expected a bool tensor of shape ({num_envs},)"
    return None


def wrong_reward(reward: object, num_envs: int, evaluate: Mapping[str, Any]) -> str | None:
    """Said of the reward's hook: it must return a floating tensor (N,).

    What is in it is the task's own affair: a NaN in one env is a value, to be seen in that env's row and on its
    timeline while the others go on, and no wrong shape.
    """
    said = no_reward(reward, num_envs)
    if said is not None or not isinstance(reward, torch.Tensor) or reward.dtype.is_floating_point:
        return said
    # ManiSkill's own sparse reward is `success` itself where a task has no `fail`.
    success = evaluate.get("success")
    if isinstance(success, torch.Tensor) and reward.dtype == torch.bool and torch.equal(reward, success):
        return None
    return f"returned {_describe(reward)}; {_floating(num_envs)}: write .float() behind it"


def no_reward(reward: object, num_envs: int) -> str | None:
    """Said of what is no real number for each env, and can be neither drawn nor recorded; truths are 0 and 1."""
    if not isinstance(reward, torch.Tensor) or not _a_row_each(reward, num_envs) or reward.dtype.is_complex:
        return f"returned {_describe(reward)}; {_floating(num_envs)}"
    return None


def _floating(num_envs: int) -> str:
    return f"expected a floating tensor of shape ({num_envs},)"


def _a_row_each(value: torch.Tensor, num_envs: int) -> bool:
    # A single truth is the row of a single env: ManiSkill and its wrappers take it, and tasks written for one env give it.
    return value.shape == (num_envs,) or (num_envs == 1 and value.ndim == 0)


def wrong_observation(obs: object, num_envs: int) -> str | None:
    """Said of an observation hook: every entry of the dict that it returns is an array (N, ...)."""
    if not isinstance(obs, Mapping):
        return f"returned {_describe(obs)}; it must return a dict ({{}} where there is nothing to observe)"
    for name, value in flat_entries(obs):
        shape = getattr(value, "shape", None)
        if shape is None or len(shape) == 0 or shape[0] != num_envs:
            return (
                f"returned {name!r} as {_describe(value)}; "
                f"expected shape ({num_envs}, ...), a row for each env"
            )
    return None


def _describe(value: object) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"a {type_text(value)}"
    if value is None:
        return "None"
    text = " ".join(safe_repr(value)[:480].split())
    return f"{type(value).__qualname__} ({text if len(text) <= 60 else text[:59] + '…'})"
