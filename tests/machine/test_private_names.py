"""Names of other packages that have moved are found, and what they disable is said."""

from __future__ import annotations

import functools
import sys
from types import ModuleType

import pytest

from workbench.machine import versions
from workbench.machine.versions import PrivateName, moved_text, rerun_notice, stored_names


class Base:
    annotated: int

    def __init__(self) -> None:
        self.assigned = 1

    @property
    def shown(self) -> int:
        return 0

    @shown.setter
    def shown(self, value: int) -> None:
        self.by_setter = value

    @classmethod
    def made(cls) -> Base:
        cls.by_class = 1  # type: ignore[attr-defined]
        return cls()

    def method(self) -> None: ...


class Derived(Base):
    class Inner:
        deep = 1


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("of_somebody")
    module.Derived, module.value = Derived, None  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "of_somebody", module)


@pytest.mark.parametrize(
    ("owner", "name", "exists"),
    [
        *[
            ("of_somebody:Derived", name, True)
            for name in ("annotated", "assigned", "by_setter", "by_class", "method", "shown")
        ],
        ("of_somebody:Derived", "gone", False),
        ("of_somebody:Derived.Inner", "deep", True),
        ("of_somebody:Derived.Gone", "deep", False),
        ("of_somebody", "value", True),
        ("of_somebody", "gone", False),
        ("of_nobody", "value", False),
    ],
)
def test_a_name_is_found_where_a_class_declares_or_assigns_it(
    package: None, owner: str, name: str, exists: bool
) -> None:
    assert PrivateName(owner, name).exists() is exists


def test_assigned_attributes_are_those_of_the_asked_variable() -> None:
    def function(scene: Base, other: Base) -> object:
        scene.first = 1  # type: ignore[attr-defined]
        other.second = scene.read  # type: ignore[attr-defined]

        def inner() -> None:
            scene.third = 2  # type: ignore[attr-defined]
            functools.fourth = 3  # type: ignore[attr-defined]

        return inner

    assert stored_names(function.__code__) == {"first", "second", "third", "fourth"}
    assert stored_names(function.__code__, "scene") == {"first", "third"}
    assert stored_names(function.__code__, "other") == {"second"}


def test_moved_names_are_listed_by_the_feature_that_needs_them() -> None:
    assert moved_text([]) == ""
    said = moved_text(
        [
            PrivateName("a.b:Camera", "_pose", "placing cameras"),
            PrivateName("a.env", "_reset"),
            PrivateName("a.b:Outer.Camera", "_size", "placing cameras"),
        ]
    )
    assert "placing cameras (needs Camera._pose, Camera._size); opening a task (needs env._reset)" in said


def test_another_rerun_is_tried_before_recordings_are_said_to_be_impossible(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert rerun_notice() == ""
    monkeypatch.setattr(versions, "installed", lambda name: "9.9" if name == "rerun-sdk" else None)
    assert rerun_notice() == "", "another version that has the names"
    monkeypatch.setitem(sys.modules, "rerun.error_utils", None)
    said = rerun_notice()
    assert "rerun.error_utils" in said and "rerun-sdk 9.9" in said and "rerun-sdk==" in said


def test_only_installed_packages_are_tested_or_not(monkeypatch: pytest.MonkeyPatch) -> None:
    have = {"viser": "1.1.1", "sapien": "2.0"}
    monkeypatch.setattr(versions, "installed", have.get)
    assert versions.untested() == {"sapien": "2.0"}
    said = versions.untested_text()
    assert "sapien 2.0" in said and "viser 1.1.1" not in said
    assert "sapien==3.0.3" in said and "viser==1.1.1" in said and "mani_skill==" not in said
    have["sapien"] = "3.0.3"
    assert versions.untested() == {} and versions.untested_text() == ""


def test_requirements_are_unmet_if_missing_or_of_another_version(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = ["viser>=1,<2", "sapien>=3", "torch", "ray>=2; extra == 'cluster'", "gone; python_version < '3'"]
    have = {"viser": "1.1.1", "sapien": "3.0.0rc1", "torch": "2"}
    monkeypatch.setattr(versions.importlib.metadata, "requires", lambda name: wanted)
    monkeypatch.setattr(versions, "installed", have.get)
    unmet = [(str(one), found) for one, found in versions.unmet_requirements()]
    assert unmet == [("sapien>=3", "3.0.0rc1")]
    del have["torch"]
    lines = versions.unmet_lines()
    assert lines is not None and "sapien>=3 is required, 3.0.0rc1 is installed; torch is missing" in lines[0]
    assert lines[1].endswith(" 'sapien>=3' torch")
    have |= {"sapien": "4", "torch": "2"}
    assert versions.unmet_lines() is None
