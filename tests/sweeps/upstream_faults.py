"""Known faults of ManiSkill 3.0.1's own tasks, each with the line that fails and its upstream issue.

An exception is excused only if its traceback contains the listed file and source line, so an entry whose fault upstream
has fixed or moved makes the sweep fail.
"""

from __future__ import annotations

import traceback
from dataclasses import dataclass

_ROTATE = "tasks/dexterity/rotate_single_object_in_hand.py"


@dataclass(frozen=True)
class Fault:
    """One fault of a built-in task with several envs, on the GPU and on the CPU."""

    ids: tuple[str, ...]
    stage: str
    """``partial reset`` or ``get_state``."""
    file: str
    """End of the path of the file that fails."""
    line: str
    """The source line that fails, stripped."""
    why: str
    upstream: str
    """Issues and pull requests of mani-skill/ManiSkill, if any was found."""


FAULTS = (
    Fault(
        tuple(f"RotateValveLevel{level}-v1" for level in range(5)),
        "partial reset",
        "tasks/dexterity/rotate_valve.py",
        "valve_rotation = (self.valve.qpos - self.rest_qpos)[:, 0]",
        "_initialize_actors replaces self.rest_qpos and self.rotate_direction by the subset's rows",
        "the fault of #1067 and #1373 (another task); not reported for this one",
    ),
    Fault(
        tuple(f"RotateValveLevel{level}-v1" for level in range(5)),
        "get_state",
        "utils/common.py",
        "return torch.hstack(states)",
        "the per-env valves stay in the state registry next to the merged valve",
        "#444, #517 (PR #676 gave tasks the means to fix it)",
    ),
    Fault(
        ("RotateSingleObjectInHandLevel1-v1",),
        "partial reset",
        _ROTATE,
        "torch.abs(new_pos[:, 2]) + self.hand_init_height + self.obj_heights",
        "self.obj_heights has a row for each env and is used without [env_idx]",
        "#1067, #1373; PR #1377 fixed the adjacent lines",
    ),
    Fault(
        ("RotateSingleObjectInHandLevel1-v1",),
        "get_state",
        "utils/common.py",
        "return torch.hstack(states)",
        "the per-env objects stay in the state registry next to the merged object",
        "#444, #517 (PR #676 gave tasks the means to fix it)",
    ),
    Fault(
        ("MS-HopperStand-v1", "MS-HopperHop-v1"),
        "partial reset",
        "tasks/control/hopper.py",
        "random_qpos *= q_ranges",
        "q_ranges has a row for each env",
        "no report found",
    ),
    Fault(
        ("DrawSVG-v1",),
        "partial reset",
        "tasks/drawing/draw_svg.py",
        "rot_mat.double() @ self.points[env_idx].transpose(-1, -2).double()",
        "self.points is replaced by the subset's rows, since hasattr asks for another name",
        "no report found",
    ),
)


def faults_of(env_id: str) -> dict[str, Fault]:
    """Return the faults of an id by stage."""
    return {fault.stage: fault for fault in FAULTS if env_id in fault.ids}


def where_it_fails(fault: Fault, error: BaseException) -> str | None:
    """Return ``file.py:line`` if the traceback contains the line of `fault`, else None."""
    for frame in traceback.extract_tb(error.__traceback__):
        if frame.filename.endswith(fault.file) and frame.line == fault.line:
            return f"{fault.file.rsplit('/', 1)[1]}:{frame.lineno}"
    return None
