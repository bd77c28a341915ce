"""Search for camera placements that see chosen objects in all envs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.envs.camera_data import CameraKey, CameraKind
from workbench.envs.indices import require_env
from workbench.envs.scene.scene_index import SceneIndex, read_poses, scene_index
from workbench.pictures.camera_conventions import (
    LookAt,
    axes_of,
    compose,
    pose_from_look_at,
    quaternion_from_axes,
    rotation_matrix,
    triple,
    with_pose,
)
from workbench.pictures.camera_report import (
    CameraReport,
    OfferedPlacement,
    SearchSpace,
    join_reports,
    report_text,
)
from workbench.pictures.temporary_camera import temporary_camera, undrawn
from workbench.pictures.visibility import (
    Placement,
    SceneObject,
    entities_of,
    list_objects,
    measure,
    mount_column,
    picture_of,
    small_size,
)

WIDE_MARGIN_SHARE = 0.1
"""Distance from an object to the border, as a share of the picture's shorter side, below which the score is
reduced."""
FREE_METRES = 0.1
"""Distance that must be free in front of the lens, for the camera's own body."""
ROBOT_DISTANCE_METRES = 0.2
"""Least distance of an eye from the origin of every robot link, in the searched envs."""
MOUNT_DISTANCE_METRES = 0.05
"""Replaces `ROBOT_DISTANCE_METRES` for a mounted camera, which is meant to be near a link."""
SUFFICIENT_SCORE = 0.995
"""No further round is sampled once `SearchSpace.best` placements have at least this score."""
ROUNDS = 2
"""Number of rounds of samples around the best candidates."""
MAX_EYE_ATTEMPTS = 50
"""Maximum number of attempts to sample an eye that is clear of the robot. If all fail, any eye is used, so
that a box within the robot can be searched too."""
_Candidate = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Eye and target, each (3,)."""


def suggest_cameras(
    env: Any,
    space: SearchSpace,
    envs: Sequence[int],
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> tuple[OfferedPlacement, ...]:
    """Search for placements in envs that are already reset; returns the best first. The envs stay unchanged.

    The returned placements keep a distance from each other, so that they are not variants of a single one.
    Fewer than `SearchSpace.best` are returned if no more are found, or if the search is
    cancelled. The same seed gives the same result.

    Args:
        progress: called after each measured view with the number so far and the maximum; keep it cheap.
        cancelled: called before each measured view; True ends the search.

    Raises:
        ValueError: no env is named; or an object is missing, is never drawn for such a camera, or is the
            robot itself.
        IndexError: there is no such env.
        RuntimeError: the renderer failed.
    """
    search = _Search(env, space, list(envs), progress, cancelled)
    return tuple(search.run())


def score_of(report: CameraReport, objects: Sequence[str]) -> float:
    """Score of a placement, 0 to 1: halfway between the average of the envs' marks and the mark of the worst
    env.

    An env's mark is the lowest mark of its objects (`ObjectSeen.marks`, reduced by up to a fifth for an
    object near the border). The env's mark is reduced if something is closer to the lens than `FREE_METRES`.
    """
    marks = []
    for thing in report.wanted_objects(objects):
        inside = 0.8 + 0.2 * np.clip(thing.margin / WIDE_MARGIN_SHARE, 0, 1)
        marks.append(np.where(thing.present, thing.marks() * inside, np.nan))
    worst = np.min(np.nan_to_num(marks, nan=np.inf), axis=0)
    room = np.clip(np.nan_to_num(report.depth.nearest) / FREE_METRES, 0, 1)
    there = np.isfinite(worst)
    known = worst[there] * room[there]
    return float((known.mean() + known.min()) / 2) if len(known) else 0.0


class _Search:
    """One run of `suggest_cameras`.

    The space is small and the score has no gradient, so it is sampled: first with eyes spread over the box,
    each looking at a point near the objects; then in `ROUNDS` smaller rounds around the best samples. Nearly
    all of a picture's cost is the robot's meshes (software driver: 2 ms without them, 30 ms with them). So
    every sample is measured without the robot, which bounds its score from above, and only the best samples
    are measured with the robot.
    """

    def __init__(
        self,
        env: Any,
        space: SearchSpace,
        envs: list[int],
        progress: Callable[[int, int], None],
        cancelled: Callable[[], bool],
    ) -> None:
        space.check()
        if not envs:
            raise ValueError("name at least one env to search in")
        for e in envs:
            require_env(e, env.num_envs)
        self.env, self.space, self.envs, self.index = env, space, envs, scene_index(env)
        self.progress, self.cancelled = progress, cancelled
        every = list_objects(env)
        self.wanted = [_wanted(every, name, space.kind, self.index) for name in space.objects]
        # A requested link of the robot is an object to see, not a part of the robot that may hide objects.
        asked = {body for thing in self.wanted for body in thing.bodies}
        robots = [replace(t, bodies=tuple(b for b in t.bodies if b not in asked)) for t in every if t.robot]
        self.objects = [*robots, *self.wanted]
        self.mounts = self._mounts()
        self.up = axes_of(space.lens.quaternion)[::2]
        self.size = small_size(space.lens.width, space.lens.height)
        self.rng = np.random.default_rng(space.seed)
        self.low, self.high = np.array(space.low, np.float64), np.array(space.high, np.float64)
        diagonal = float(np.linalg.norm(self.high - self.low))
        self.apart = max(diagonal / 7, 0.01) if space.apart is None else space.apart
        self.middle, self.spread = self._where_the_objects_are()
        self.links = self._places([thing for thing in every if thing.robot])
        self.keep = max(12, 3 * space.best)
        near = 8 * space.best
        self.total = len(envs) * (space.candidates + self.keep + ROUNDS * (near + 2 * space.best))
        self.done = 0
        self.found: list[tuple[float, _Candidate, CameraReport]] = []

    def run(self) -> Iterator[OfferedPlacement]:
        drawn = [self._draw() for _ in range(self.space.candidates)]
        self._measure_best_of(drawn, self.keep)
        for round_ in range(ROUNDS):
            chosen = self._chosen()
            if len(chosen) == self.space.best and chosen[-1][0] >= SUFFICIENT_SCORE:
                break
            centres = [candidate for _, candidate, _ in chosen]
            reach = 0.12 / (round_ + 1)
            near = [self._draw_near(centre, reach) for centre in centres for _ in range(8)]
            self._measure_best_of(near, 2 * len(centres))
        self.progress(self.total, self.total)
        for score, candidate, report in self._chosen():
            yield self._suggestion(score, candidate, report)

    def _measure_best_of(self, candidates: list[_Candidate], keep: int) -> None:
        """Score all candidates without the robot, which bounds the score from above, then the best `keep`
        candidates with the robot."""
        bare = self._measure(candidates)
        scores = [score_of(join_reports(row), self.space.objects) for row in bare]
        order = np.argsort([-score for score in scores], kind="stable").tolist()
        best = [i for i in order if scores[i] > 0][:keep]
        whole = self._measure([candidates[i] for i in best], [bare[i] for i in best])
        for i, row in zip(best, whole, strict=False):
            report = join_reports(row)
            self.found.append((score_of(report, self.space.objects), candidates[i], report))

    def _near(self, a: _Candidate, b: _Candidate) -> bool:
        return bool(np.linalg.norm(a[0] - b[0]) < self.apart)

    def _measure(
        self, candidates: list[_Candidate], bare: list[list[CameraReport]] | None = None
    ) -> list[list[CameraReport]]:
        """Reports of each candidate in each env: with the robot if `bare` (the reports without the robot) is
        given, else without the robot. Empty if cancelled."""
        measured: list[list[CameraReport]] = [[] for _ in candidates]
        key: CameraKey = (self.space.kind, "suggested")
        local = [self._pose(candidate) for candidate in candidates]
        for position, e in enumerate(self.envs):
            robots = [x for thing in self.objects if thing.robot for x in entities_of(thing, e, self.index)]
            poses = local if self.mounts is None else [compose(self.mounts[e], pose) for pose in local]
            with (
                temporary_camera(self.env, e, self.space.kind, self.space.lens, self.size) as view,
                undrawn(robots if bare is None else []),
            ):
                for i, pose in enumerate(poses):
                    if self.cancelled():
                        return []
                    known = None if bare is None else bare[i][position]
                    measured[i].append(
                        measure(view, pose, e, self.objects, self.index, key, self.space.lens, known)
                    )
                    self.done += 1
                    self.progress(self.done, self.total)
        return measured

    def _chosen(self) -> list[tuple[float, _Candidate, CameraReport]]:
        """The best candidates that are not close to each other."""
        chosen: list[tuple[float, _Candidate, CameraReport]] = []
        for entry in sorted(self.found, key=lambda entry: -entry[0]):
            if entry[0] > 0 and not any(self._near(entry[1], other[1]) for other in chosen):
                chosen.append(entry)
            if len(chosen) == self.space.best:
                break
        return chosen

    def _draw(self) -> _Candidate:
        eye = self.rng.uniform(self.low, self.high)
        for _ in range(MAX_EYE_ATTEMPTS):
            if self._is_clear(eye):
                break
            eye = self.rng.uniform(self.low, self.high)
        return eye, self._apart_from(eye, self.middle + self.rng.uniform(-0.5, 0.5, 3) * self.spread)

    def _draw_near(self, centre: _Candidate, reach: float) -> _Candidate:
        eye = np.clip(centre[0] + self.rng.normal(0, reach, 3) * (self.high - self.low), self.low, self.high)
        eye = eye if self._is_clear(eye) else centre[0]
        return eye, self._apart_from(eye, centre[1] + self.rng.normal(0, 0.5, 3) * reach * self.spread)

    def _is_clear(self, eye: NDArray[np.float64]) -> bool:
        least = ROBOT_DISTANCE_METRES if self.mounts is None else MOUNT_DISTANCE_METRES
        return not len(self.links) or np.linalg.norm(self.links - eye, axis=1).min() >= least

    def _apart_from(self, eye: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
        # The box may contain the objects, so an eye may be at its target, where it would have no direction.
        return target if np.linalg.norm(target - eye) > 1e-3 else target - [0.0, 0.0, 0.01]

    def _where_the_objects_are(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centre and extent (3,) of the requested objects over all envs."""
        places = self._places(self.wanted)
        if not len(places):
            names = ", ".join(self.space.objects)
            raise ValueError(f"none of the envs to search in has {names}")
        low, high = places.min(axis=0), places.max(axis=0)
        return (low + high) / 2, np.maximum(high - low, 0.05)

    def _places(self, things: Sequence[SceneObject]) -> NDArray[np.float64]:
        """(K, 3) positions of the objects' bodies in all envs that have them, in the frame of the mount if there is one."""
        bodies = read_poses(self.env)
        columns = [body for thing in things for body in thing.bodies]
        places = bodies[self.envs][:, columns, :3].astype(np.float64)
        if self.mounts is not None:
            for row, e in zip(places, self.envs, strict=True):
                mount = self.mounts[e]
                row[:] = (row - mount[:3]) @ rotation_matrix(mount[3:])
        places = places.reshape(-1, 3)
        return places[np.isfinite(places).all(axis=1)]

    def _mounts(self) -> NDArray[np.float32] | None:
        """(N, 7) pose of the mount in each env; None without a mount."""
        name = self.space.mount
        if name is None:
            return None
        mounts = read_poses(self.env)[:, mount_column(self.index, name)]
        if not np.isfinite(mounts[self.envs]).all():
            raise ValueError(f"not every env has a body {name!r} to mount a camera on")
        return mounts

    def _pose(self, candidate: _Candidate) -> NDArray[np.float64]:
        """(7,) pose of a candidate, in the mount's or the env's frame."""
        if self.mounts is None:
            return pose_from_look_at(LookAt(triple(candidate[0]), triple(candidate[1])))
        # A link's frame has no "up" direction: the picture keeps the up direction of the present camera.
        eye, target = candidate
        forward, up = target - eye, self.up[1]
        if abs(float(forward @ up)) > 0.999 * float(np.linalg.norm(forward)):
            up = -self.up[0] * np.sign(forward @ up)
        return np.concatenate([eye, quaternion_from_axes(forward, up)])

    def _suggestion(self, score: float, candidate: _Candidate, report: CameraReport) -> OfferedPlacement:
        settings = with_pose(self.space.lens, self._pose(candidate))
        worst = report.worst_first(self.space.objects)[0]
        e = report.envs[worst]
        placement = Placement(settings, self.space.kind, self.space.mount)
        return OfferedPlacement(
            settings=settings,
            target=triple(candidate[1]),
            score=score,
            words=report_text(report, self.space.objects),
            report=report,
            picture=picture_of(self.env, e, placement),
        )


def _wanted(objects: Sequence[SceneObject], name: str, kind: CameraKind, index: SceneIndex) -> SceneObject:
    found = next((thing for thing in objects if thing.name == name), None)
    if found is None and name in index.names:
        body = index.names.index(name)
        whole = next((thing for thing in objects if body in thing.bodies), None)
        found = None if whole is None else replace(whole, name=name, bodies=(body,), robot=False)
    there = ", ".join(thing.name for thing in objects if not (thing.robot or thing.name == "ground"))
    if found is None or found.name == "ground":
        raise ValueError(f"{name!r} is not an object to search a view of; choose from: {there}")
    if found.robot:
        raise ValueError(
            f"{name!r} is the robot: name links of it ({name}/...), or objects of the task: {there}"
        )
    if found.hidden and kind == "sensor":
        raise ValueError(f"the task hides {name!r} from its sensors: no placement can see it")
    return found
