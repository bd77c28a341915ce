"""The Inspect tab: joints, contacts, poses, observation or state of one env, and contact forces in the 3-D view."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, get_args

import numpy as np
import viser
from numpy.typing import NDArray

from workbench.envs.inspection import SECTIONS, BodyReadings, Inspection, JointReadings, Leaf, Section
from workbench.envs.scene.shapes import SceneGeometry
from workbench.live.commands import ChooseInspected, FindBodies, HoverBody, SelectBody, ShowForces
from workbench.live.events import ReadingChosen
from workbench.live.inspect_polling import READ_PERIOD_SECONDS
from workbench.live.session_protocol import LiveSession
from workbench.live.view import SessionView
from workbench.machine.text import number_text
from workbench.page.command import Command
from workbench.page.commands import ShownOn
from workbench.page.scene.env_grid import InView
from workbench.page.widgets.fields import Field, choice
from workbench.page.widgets.open_tabs import OpenTabs
from workbench.page.widgets.parts import Clock, DrawThrottle, PagePart
from workbench.page.widgets.templates import render
from workbench.page.widgets.visitors import Visitor

TAB = "Inspect"
NEAR_LIMIT_SHARE = 0.02
"""Share of a joint's range, at each end, in which the joint counts as near its limit."""

Row = dict[str, Any]
"""A row of the template ``inspect``."""


def leaf_rows(leaves: Sequence[Leaf], before: Sequence[Leaf] | None) -> list[Row]:
    """One row per array; numbers that differ from the previous reading are marked.

    Args:
        before: the previous reading of the same env; None marks nothing.
    """
    known = {leaf.name: leaf.values for leaf in before or ()}
    rows = []
    for leaf in leaves:
        old = known.get(leaf.name)
        if old is None or old.shape != leaf.values.shape:
            changed = np.zeros(leaf.values.shape, bool)
        else:
            # NaN differs from itself, but an entry that stays NaN has not changed.
            changed = (old != leaf.values) & ~((old != old) & (leaf.values != leaf.values))
        count = math.prod(leaf.shape)
        whole = len(leaf.values) == count
        rows.append(
            {
                "name": leaf.name,
                "kind": f"{leaf.dtype} {leaf.shape}" if leaf.shape else leaf.dtype,
                "numbers": tuple(
                    {"text": number(value), "changed": bool(new)}
                    for value, new in zip(leaf.values.tolist(), changed.tolist(), strict=True)
                )
                if whole
                else (),
                "note": "" if whole else f"{count} numbers from {number(leaf.low)} to {number(leaf.high)}",
            }
        )
    return rows


def joint_rows(joints: JointReadings) -> list[Row]:
    rows = []
    for i, name in enumerate(joints.names):
        low, high = float(joints.low[i]), float(joints.high[i])
        unit = "m" if joints.kinds[i] == "prismatic" else "rad"
        bounded = math.isfinite(low) and math.isfinite(high) and high > low
        place = _place(float(joints.position[i]), low, high) if bounded else None
        target = float(joints.target[i])
        rows.append(
            {
                "name": name,
                "position": number(float(joints.position[i])),
                "target": "" if math.isnan(target) else number(target),
                "velocity": number(float(joints.velocity[i])),
                "limits": f"{number(low)} to {number(high)} {unit}" if bounded else f"no limits, {unit}",
                "place": place,
                "target_place": None if place is None or math.isnan(target) else _place(target, low, high),
                "at_limit": place is not None
                and not 100 * NEAR_LIMIT_SHARE < place < 100 * (1 - NEAR_LIMIT_SHARE),
            }
        )
    return rows


def pose_rows(names: Sequence[str], poses: NDArray[np.float32]) -> list[Row]:
    """One row per body of an env; `poses` is (B, 7), p and q (wxyz), NaN for bodies that the env lacks."""
    rows = []
    for name, pose in zip(names, poses, strict=True):
        if np.isfinite(pose).all():
            p, q = pose[:3], pose[3:]
            code = f"sapien.Pose(p={_code(p)}, q={_code(q)})"
            rows.append({"name": name, "p": pose_text(p), "q": pose_text(q), "code": code})
    return rows


def number(value: object) -> str:
    """Short text of a value; its width stays stable while the value changes."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return number_text(value)
    if value and not 1e-3 <= abs(value) < 1e4:
        return "0.000" if abs(value) < 1e-6 else f"{value:.1e}"
    return f"{value:.3f}"


def pose_text(values: NDArray) -> str:
    """Text of a position or a quaternion, to 0.1 mm: an exponent among plain numbers is easily overlooked."""
    return ", ".join(f"{round(float(value), 4) + 0.0:.4f}" for value in values)


def vector(values: NDArray) -> str:
    return ", ".join(number(float(value)) for value in values)


def _place(value: float, low: float, high: float) -> float:
    return round(100 * min(max((value - low) / (high - low), 0.0), 1.0), 1)


def strength(values: NDArray) -> str:
    """Text of the norm of a force or an impulse (3,)."""
    return number_text(float(np.linalg.norm(values)), ".3g")


def _code(values: NDArray[np.float32]) -> str:
    # Six decimals: a micrometre, and the precision of float32.
    return "[" + ", ".join(f"{float(value):.6f}".rstrip("0").rstrip(".") or "0" for value in values) + "]"


_STILL: dict[str, int] = {"dynamic": 0, "kinematic": 2, "static": 3}
"""Rank of each kind of body in a list; articulations have rank 1. Bodies that move come first."""


def body_groups(
    geometry: SceneGeometry, poses: NDArray[np.float32], text: str = ""
) -> list[tuple[str, list[Row]]]:
    """Rows of an env's bodies in named groups: links by articulation, other bodies by kind.

    Args:
        poses: (B, 7), NaN for bodies that the env lacks.
        text: text that the names must contain; upper and lower case are equal.
    """
    groups: dict[str, list[int]] = {}
    for row, (name, kind) in enumerate(zip(geometry.body_names, geometry.body_kinds, strict=True)):
        if text.casefold() in name.casefold():
            groups.setdefault(name.partition("/")[0] if kind == "link" else kind, []).append(row)
    listed = [
        (name, pose_rows([geometry.body_names[row] for row in rows], poses[rows]))
        for name, rows in sorted(groups.items(), key=lambda group: _STILL.get(group[0], 1))
    ]
    return [(name, rows) for name, rows in listed if rows]


NOTHING, JOINTS, BODIES = "nothing", "joints", "bodies"
CHOICES: dict[str, Section | None] = {
    NOTHING: None,
    JOINTS: "joints",
    "contacts": "contacts",
    BODIES: None,
    "observation": "observation",
    "state": "state",
}


class InspectPanel(PagePart[SessionView]):
    """Reads the chosen section of the selected env from the worker.

    Only what a page shows is read, since reading takes the worker's time.

    Args:
        tabs: The open tab of each page.
    """

    does = (ChooseInspected, FindBodies, SelectBody, HoverBody, ShowForces)

    def __init__(
        self,
        server: viser.ViserServer,
        session: LiveSession,
        tabs: OpenTabs,
        clock: Clock = time.monotonic,
    ) -> None:
        self._session, self._tabs = session, tabs
        self._chosen = JOINTS
        self._forces_on: ShownOn = "off"
        self.body = ""
        """Name of the selected body; empty for none."""
        self.hovered = ""
        """Name of the body on whose row the pointer is; empty for none."""
        self._of_body = server.gui.add_html("", visible=False)
        self.below_body = self._of_body.order + 0.5
        """viser's order of what belongs to the selected body."""
        self._show = choice(
            server,
            "Show",
            ChooseInspected,
            "what",
            tuple(CHOICES),
            JOINTS,
            hint="Read from the selected env, five times a second.",
        )
        self._forces = choice(
            server,
            "Force arrows",
            ShowForces,
            "where",
            get_args(ShownOn),
            self._forces_on,
            hint="Draw the contact forces of the selected env as arrows in the 3D view.",
        )
        self._found = ""
        """Text that the names of listed bodies contain."""
        self._find = Field(
            server,
            "Find",
            FindBodies,
            "text",
            "",
            hint="List only bodies whose name contains this text.",
            live=True,
            longest=100,
        )
        self._handle = server.gui.add_html("")
        self._now: Inspection | None = None
        self._before: Inspection | None = None
        self._due = DrawThrottle(READ_PERIOD_SECONDS, clock)

    def draw(self, view: SessionView) -> None:
        chosen = self._chosen
        self._show.show(chosen)
        self._forces.show(self._forces_on)
        self._take(view)
        no_step = self._no_step_yet(view)
        self._find.visible = chosen == BODIES
        self._find.show(self._found)
        asked = chosen, self.body, self._found
        wanted = (asked, view.task_serial, view.selected_env, id(self._now), no_step)
        if chosen == BODIES or self.body:
            wanted = (*wanted, view.step_serial)
        if not self._due.is_due(wanted, urgent=asked):
            return
        content = body_html(self.body, view, None if no_step else self._now)
        self._of_body.content, self._of_body.visible = content, bool(content)
        self._handle.content = inspect_html(chosen, view, self._now, self._before, no_step, self._found)

    def do(self, command: Command, visitor: Visitor) -> None:
        match command:
            case ChooseInspected(what=what):
                self._chosen = what
                self.choose_sections()
            case FindBodies(text=text):
                self._found = text
            case SelectBody(body=body):
                self.select(body)
            case HoverBody(body=body):
                self.hovered = body
            case ShowForces(where=where):
                self._forces_on = where
                self.choose_sections()

    def body_reading(self, view: SessionView) -> BodyReadings | None:
        """The live reading of the selected body in the selected env; None if there is none."""
        here = self._now is not None and self._now.env == view.selected_env
        return self._now.body if self._now is not None and here and view.timeline.shown is None else None

    def forces(self, view: SessionView) -> Inspection | None:
        """The reading whose contacts the 3-D view shows. None to show no contacts, for example at a past
        moment: contacts are read only from the live env."""
        here = self._now is not None and self._now.env == view.selected_env
        known = view.timeline.shown is None and not self._no_step_yet(view)
        shown = self._tabs.shows(self._forces_on, TAB) and here and known
        return self._now if shown else None

    def select(self, body: str) -> None:
        """Select the body with this name; empty for none."""
        self.body = body
        self.choose_sections()

    def _no_step_yet(self, view: SessionView) -> bool:
        """Whether the selected env has made no step since it was built, reset or restored. PhysX finds contacts while it
        steps: until then its list is empty or outdated."""
        if self._now is not None and self._now.env == view.selected_env and self._now.elapsed_steps == 0:
            return True
        lived = self._session.look(lambda run: run.segment()) if view.timeline.shown is None else None
        return lived is not None and lived[0] == lived[1]

    def choose_sections(self) -> None:
        """Choose the sections that the session reads; call it also when a page opens another tab."""
        is_open = bool(self._tabs.pages_at(TAB))
        shows_contacts = self._tabs.shows(self._forces_on, TAB) or (self.body and is_open)
        needed = {CHOICES[self._chosen] if is_open else None, "contacts" if shows_contacts else None}
        sections: tuple[Section, ...] = tuple(section for section in SECTIONS if section in needed)
        self._session.dispatch(ReadingChosen(sections, self.body if is_open else ""))

    def _take(self, view: SessionView) -> None:
        new = view.inspection
        if new is self._now:
            return
        old = self._now
        if new is None or old is None or old.env != new.env:
            self._before = None
        elif old.elapsed_steps != new.elapsed_steps:
            self._before = old
        self._now = new


def inspect_html(
    choice: str,
    view: SessionView,
    now: Inspection | None,
    before: Inspection | None,
    no_step_yet: bool = False,
    found: str = "",
) -> str:
    """The tab's content.

    Args:
        no_step_yet: the env has made no step since it was reset or restored: leave out contacts.
        found: text that the names of listed bodies contain.
    """
    leaves, articulations, contacts, groups = [], [], (), []
    note = ""
    env, section = view.selected_env, CHOICES[choice]
    if view.task is None or view.step is None:
        note = "There is nothing to inspect until the task has loaded."
    elif choice == NOTHING:
        note = (
            "Choose what to read of the selected env: its joints, contacts, bodies with their poses, the observation "
            "or the simulation state. Nothing is read until then."
        )
    elif choice == BODIES:
        geometry = view.task.geometry
        if view.step.poses.shape[:2] == (view.task.num_envs, len(geometry.body_names)):
            groups = body_groups(geometry, view.step.poses[env], found)
        note = f"env {env}: metres, quaternions w x y z, in the env's own frame"
        if found and not groups:
            note = f"No body of env {env} has {found!r} in its name."
    elif now is None or now.env != env or _reading(now, section) is None:
        refused = dict(now.refused) if now is not None and now.env == env else {}
        note = refused.get(section, f"Reading env {env} ...") if section else ""
    else:
        note = f"env {env} at step {now.elapsed_steps} of its episode"
        if section == "joints":
            articulations = [{"name": a.articulation, "joints": joint_rows(a)} for a in now.joints or ()]
            note += "; bars show the position between the limits, and the target in orange"
        elif section == "contacts":
            contacts = () if no_step_yet else now.contacts or ()
            if no_step_yet:
                note += ": contacts are known after the next step"
            elif not contacts:
                note += ": nothing touches anything"
        elif section == "observation":
            leaves = leaf_rows(now.observation or (), before.observation if before else None)
        elif section == "state":
            leaves = leaf_rows(now.state or (), before.state if before else None)
        if view.timeline.shown is not None:
            note += "; these values are live: only poses are kept for past moments"
        if section in ("observation", "state"):
            note += "; numbers that changed since the previous reading are blue"
    return render(
        "inspect",
        note=note,
        leaves=leaves,
        articulations=articulations,
        contacts=contacts,
        groups=groups,
        select=lambda name: SelectBody(body=name),
        hover=lambda name: HoverBody(body=name),
        vector=vector,
        strength=strength,
    )


def body_html(body: str, view: SessionView, now: Inspection | None) -> str:
    """Pose and contacts of the selected body; empty if none is selected, or the task has no such body.

    Args:
        now: the last reading; None if the env's contacts are not known.
    """
    env, step = view.selected_env, view.step
    geometry = None if view.task is None else view.task.geometry
    if step is None or geometry is None or body not in geometry.body_names:
        return ""
    if step.poses.shape[1] != len(geometry.body_names):
        return ""
    row = geometry.body_names.index(body)
    poses = pose_rows((body,), step.poses[env, row : row + 1])
    contacts = None
    if now is not None and now.env == env and now.contacts is not None and view.timeline.shown is None:
        contacts = [
            (pair.bodies[body == pair.bodies[0]], strength(pair.force))
            for pair in now.contacts
            if body in pair.bodies
        ]
    return render(
        "inspect_body",
        name=body,
        about=f"{geometry.body_kinds[row]}, env {env}",
        pose=poses[0] if poses else None,
        contacts=contacts,
        facts=body_facts(now, body) if now is not None and now.env == env else [],
        clear=SelectBody(body=""),
        select=lambda name: SelectBody(body=name),
        hover=lambda name: HoverBody(body=name),
    )


def body_facts(now: Inspection, body: str) -> list[tuple[str, str]]:
    """Physical properties of the selected body: name and value with its unit."""
    read = now.body
    if read is None or read.name != body:
        return []
    facts = []
    if read.mass is not None and read.inertia is not None and read.centre_of_mass is not None:
        facts += [
            ("mass", f"{number_text(read.mass, '.4g')} kg" + ("" if read.has_gravity else ", no gravity")),
            ("inertia", f"{', '.join(number_text(float(one), '.3g') for one in read.inertia)} kg m²"),
            ("centre of mass", f"{vector(read.centre_of_mass)} m"),
        ]
    if read.velocity is not None and read.angular_velocity is not None:
        facts.append(("velocity", f"{strength(read.velocity)} m/s, {strength(read.angular_velocity)} rad/s"))
    counts = {kind: read.shapes.count(kind) for kind in dict.fromkeys(read.shapes)}
    shapes = ", ".join(f"{count} × {kind}" if count > 1 else kind for kind, count in counts.items())
    facts.append(("collision", shapes or "none"))
    for static, dynamic, restitution in read.materials:
        facts.append(
            ("friction", f"{static:.3g} static, {dynamic:.3g} dynamic; restitution {restitution:.3g}")
        )
    if (joint := read.joint) is not None:
        unit = "m" if joint.kind == "prismatic" else "rad"
        limited = math.isfinite(joint.low) and math.isfinite(joint.high)
        limits = f"{number(joint.low)} to {number(joint.high)} {unit}" if limited else "no limits"
        facts.append(("joint", f"{joint.name}, {joint.kind.removesuffix('_unwrapped')}, {limits}"))
    return facts


def _reading(now: Inspection, section: Section | None) -> object:
    return None if section is None else getattr(now, section)


FORCE_COLOUR = (255, 0, 200)
"""Magenta, unlike wood, steel, goals and cubes."""
METRES_AT_ONE_NEWTON = 0.07
MAX_ARROW_METRES = 0.3
SHAFT_METRES, HEAD_METRES, HEAD_LENGTH_METRES = 0.005, 0.012, 0.028
"""Radii of the arrow's shaft and head, and length of its head; viser does not draw an arrow shorter than its head as an
arrow."""
MIN_NEWTONS = 1e-3
"""Minimum force that is drawn."""


class ForceArrows:
    """Draws the contact forces of one env as arrows in the 3D view.

    One arrow per contact point, along the force on the first body of the pair. Forces span five decades (a cube's
    weight on four corners, a hand pressed into a table), so the length grows with the cube root of the force and is
    bounded; the numbers are in the Inspect tab.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        look = {"shaft_radius": SHAFT_METRES, "head_radius": HEAD_METRES, "head_length": HEAD_LENGTH_METRES}
        add = partial(server.scene.add_arrows, "/forces", colors=FORCE_COLOUR, **look)
        self._arrows = InView(add, "points")

    def draw(self, inspection: Inspection | None, offset: NDArray[np.float32]) -> None:
        """Show the contacts of this reading, or nothing.

        Args:
            offset: (3,) position of the env in the view.
        """
        arrows = () if inspection is None else arrows_of(inspection)
        if len(arrows):
            self._arrows.draw(arrows + offset)
        else:
            self._arrows.draw()


def arrows_of(inspection: Inspection) -> NDArray[np.float32]:
    """(A, 2, 3) start and end of each arrow, metres, in the env's own frame."""
    pairs = inspection.contacts or ()
    if not pairs:
        return np.zeros((0, 2, 3), np.float32)
    points = np.concatenate([pair.points for pair in pairs])
    forces = np.concatenate([pair.forces for pair in pairs])
    size = np.linalg.norm(forces, axis=1)
    shown = np.isfinite(size) & (size > MIN_NEWTONS)
    points, forces, size = points[shown], forces[shown], size[shown]
    length = np.minimum(METRES_AT_ONE_NEWTON * np.cbrt(size), MAX_ARROW_METRES)
    return np.stack([points, points + forces / size[:, None] * length[:, None]], axis=1).astype(np.float32)
