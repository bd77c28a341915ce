"""Text put into what a hook returns: into its list or dict, beside its one config, or a hook of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import libcst as cst

from workbench.authoring.camera_source.bindings import Binding
from workbench.authoring.camera_source.definitions import Project
from workbench.authoring.camera_source.result import Refused
from workbench.authoring.camera_source.snippet import repr_text
from workbench.authoring.camera_source.source_file import Replacement, SourceFile, walk
from workbench.authoring.camera_source.write_pose import import_place
from workbench.core.camera_settings import CameraSettings
from workbench.core.pictures import CameraKind

Hook = Literal["_default_sensor_configs", "_default_human_render_camera_configs"]
HOOK_OF: dict[CameraKind, Hook] = {
    "sensor": "_default_sensor_configs",
    "human": "_default_human_render_camera_configs",
}
_BARE = ("BaseEnv", "object")
"""Classes without cameras."""
_CONFIG = "from mani_skill.sensors.camera import CameraConfig\n"


def needed_imports(
    project: Project,
    file: SourceFile,
    settings: CameraSettings,
    with_sapien: bool = True,
    more: Sequence[tuple[str, str]] = (),
) -> tuple[list[Replacement], list[str]]:
    """What is missing at the top of the file; `more` are names, each with its line."""
    wanted = [("CameraConfig", _CONFIG), *more]
    if with_sapien:
        wanted.append(("sapien", "import sapien\n"))
    if settings.intrinsic is not None:
        wanted.append(("np", "import numpy as np\n"))
    bindings = project.bindings(file, file.module)
    missing = [line for name, line in wanted if not _imported_as(bindings.get(name, []), name)]
    if not missing:
        return [], []
    place = import_place(file)
    text = "".join(sorted(missing, key=lambda line: line.startswith("from")))
    return [Replacement(place, place, text)], [
        f"`{line.strip()}` is added at the top of the file" for line in missing
    ]


def _imported_as(bindings: list[Binding], name: str) -> bool:
    dotted = bindings[-1].dotted if bindings else None
    if bindings and dotted is None:
        raise Refused(
            f"`{name}` means something else in this file (line {bindings[-1].file.line(bindings[-1].node)})"
        )
    return dotted is not None


def returned(file: SourceFile, function: cst.FunctionDef) -> cst.BaseExpression:
    """The one expression that a hook returns."""
    found = [node for node in walk(function.body) if isinstance(node, cst.Return)]
    found = [node for node in found if file.scopes(node)[0] is function]
    name = function.name.value
    if len(found) != 1 or found[0].value is None:
        raise Refused(
            f"{name} (line {file.line(function)}) has {len(found)} returns; one is needed to add to"
        )
    value = found[0].value
    if isinstance(value, cst.Name):
        assigned = [
            node
            for node in walk(function.body)
            if isinstance(node, cst.Assign)
            and any(isinstance(t.target, cst.Name) and t.target.value == value.value for t in node.targets)
        ]
        if len(assigned) == 1 and isinstance(assigned[0].value, (cst.List, cst.Dict)):
            return assigned[0].value
    return value


def appended(
    file: SourceFile, value: cst.BaseExpression, uid: str, text: Callable[[str], str]
) -> list[Replacement]:
    """`text(indent)` as one more of what `value` holds."""
    line = file.line_text(file.line(value))
    indent = line[: len(line) - len(line.lstrip())]
    if isinstance(value, cst.Tuple) and not value.lpar:
        # It has no brackets to put one more into.
        start, end = file.span(value)
        own = indent + "    "
        held = [file.code(element.value).replace("\n", "\n    ") for element in value.elements]
        lines = "".join(f"{own}{line},\n" for line in (*held, text(own)))
        return [Replacement(start, end, f"[\n{lines}{indent}]")]
    if isinstance(value, (cst.List, cst.Tuple)):
        start, end = file.span(value)
        return _into_brackets(file, value.elements, start, end, indent, text)
    if isinstance(value, cst.Dict):
        start, end = file.span(value)
        return _into_brackets(
            file, value.elements, start, end, indent, lambda i: f"{repr_text(uid)}: {text(i)}"
        )
    if isinstance(value, cst.Call) and file.code(value.func) == "dict":
        close = file.inner_span(value)[1] - 1
        open_ = file.span(value.func)[1]
        return _into_brackets(file, value.args, open_, close + 1, indent, lambda i: f"{uid}={text(i)}")
    if isinstance(value, cst.Call) and file.code(value.func).rpartition(".")[2].endswith("CameraConfig"):
        start, end = file.span(value)
        inner = file.text[start:end].replace("\n", "\n    ")
        new = f"[\n{indent}    {inner},\n{indent}    {text(indent + '    ')},\n{indent}]"
        return [Replacement(start, end, new)]
    raise Refused(
        f"what is returned at line {file.line(value)} is neither a CameraConfig(...) nor a list or dict of them"
    )


def _into_brackets(file: SourceFile, elements, start: int, end: int, indent: str, text) -> list[Replacement]:
    close = end - 1
    if not elements:
        new = f"\n{indent}    {text(indent + '    ')},\n{indent}"
        return [Replacement(start + 1, close, new)]
    last = elements[-1]
    last_end = file.span(last.value)[1]
    comma = isinstance(last.comma, cst.Comma)
    closing = file.line_at(close)
    before = file.text[file.line_start(closing) : close]
    if not before.strip() and closing != file.line_at(start):
        own = before + "    "
        at = file.line_start(closing)
        found = [Replacement(at, at, f"{own}{text(own)},\n")]
        return found if comma else [Replacement(last_end, last_end, ","), *found]
    own = indent + "    "
    if comma:
        last_end = file.text.index(",", last_end) + 1
    found = []
    if closing == file.line_at(start):
        # What stood on one line gets a line each, or the first would share one with the bracket.
        gaps = [start + 1, *(file.text.index(",", file.span(e.value)[1]) + 1 for e in elements[:-1])]
        found = [
            Replacement(gap, _start_of(file, element), f"\n{own}")
            for gap, element in zip(gaps, elements, strict=True)
        ]
    return [*found, Replacement(last_end, close, f"{'' if comma else ','}\n{own}{text(own)},\n{indent}")]


def _start_of(file: SourceFile, element: cst.CSTNode) -> int:
    return (file.span(element.value) if isinstance(element, cst.Element) else file.inner_span(element))[0]


def new_hook(
    project: Project, file: SourceFile, cls: cst.ClassDef, hook: Hook, text: Callable[[str], str]
) -> list[Replacement]:
    """The hook, which returns the one camera that `text(indent)` is."""
    for where, parent in project.above(file, cls, []):
        if hook in project.bindings(where, parent):
            raise Refused(
                f"{cls.name.value} inherits {hook} from {parent.name.value} ({where.name}); add the camera there"
            )
        for base in parent.bases:
            name = where.code(base.value)
            if project.class_named(where, base.value) is None and name.rpartition(".")[2] not in _BARE:
                raise Refused(
                    f"{parent.name.value} inherits from {name}, whose cameras a {hook} of its own would take away"
                )

    def whole(indent: str) -> str:
        inner = indent + "    "
        return (
            f"{indent}@property\n{indent}def {hook}(self):\n{inner}return [\n"
            f"{inner}    {text(inner + '    ')},\n{inner}]\n"
        )

    return [at_end_of_class(file, cls, hook, whole)]


def class_named(file: SourceFile, name: str) -> cst.ClassDef:
    """The class of that name at the top level of the file. Raises Refused."""
    for node in file.module.body:
        if isinstance(node, cst.ClassDef) and node.name.value == name:
            return node
    raise Refused(f"there is no class {name} in {file.name}")


def at_end_of_class(
    file: SourceFile, cls: cst.ClassDef, hook: Hook, text: Callable[[str], str]
) -> Replacement:
    """`text(indent)`, the whole hook, as the last of the class."""
    if not isinstance(cls.body, cst.IndentedBlock) or not cls.body.body:
        raise Refused(f"the class {cls.name.value} has no body to add {hook} to")
    first = cls.body.body[0]
    line = file.line_text(file.line(first))
    indent = line[: len(line) - len(line.lstrip())]
    end = file.span(cls.body.body[-1])[1]
    end = file.text.find("\n", end)
    at = len(file.text) if end < 0 else end + 1
    lead = "\n" if end >= 0 else "\n\n"
    return Replacement(at, at, f"{lead}{text(indent)}")
