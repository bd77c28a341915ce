"""Deep equality of an episode or a part of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from workbench.episodes.encoded_pictures import EncodedPictures


def assert_equal(found: Any, wanted: Any, at: str = "it") -> None:
    """Assert that dataclasses, mappings, sequences, arrays (dtypes included) and decoded pictures are equal.

    A failure names the part that differs.
    """
    if isinstance(wanted, EncodedPictures):
        assert len(found) == len(wanted), at
        for index in range(len(wanted)):
            assert_equal(found[index], wanted[index], f"{at}[{index}]")
    elif isinstance(wanted, np.ndarray):
        np.testing.assert_array_equal(found, wanted, at, strict=True)
    elif is_dataclass(wanted):
        assert type(found) is type(wanted), at
        for field in fields(wanted):
            assert_equal(getattr(found, field.name), getattr(wanted, field.name), f"{at}.{field.name}")
    elif isinstance(wanted, Mapping):
        assert list(found) == list(wanted), at
        for name, value in wanted.items():
            assert_equal(found[name], value, f"{at}[{name!r}]")
    elif isinstance(wanted, (list, tuple)):
        assert len(found) == len(wanted), at
        for index, value in enumerate(wanted):
            assert_equal(found[index], value, f"{at}[{index}]")
    else:
        assert found == wanted, at
