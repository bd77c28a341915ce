"""Files of libraries are told from those that a person wrote."""

from __future__ import annotations

import json
import os
from pathlib import Path

import mani_skill
import pytest
import torch

from workbench.machine import library_files
from workbench.machine.library_files import is_installed


@pytest.mark.parametrize(
    ("file", "installed"),
    [
        *[(module.__file__, True) for module in (json, os, torch, mani_skill, library_files)],
        ("<string>", True),
        ("sapien/scene.cpp", True),
        ("/opt/lab/lib/python3/dist-packages/lab/envs.py", True),
        ("/home/me/site-packages-of-mine/envs.py", False),
        ("/home/me/task.py", False),
        (str(Path(__file__)), False),
        (f"{Path(library_files.__file__).parents[1]}_mine/task.py", False),
    ],
)
def test_a_file_is_installed_or_the_authors(file: str, installed: bool) -> None:
    assert is_installed(file) is installed
