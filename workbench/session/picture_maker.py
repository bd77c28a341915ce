"""Pictures of the cameras on screen, made beside the simulation and never in its way.

A picture takes 25 to 90 ms on a software renderer; made in one go between two steps it would halve the
rate of the player. But the renderer works on its own threads (see `begin_pictures`): so a picture is
begun, steps go on, and it is fetched when it should be ready, by what the last ones took. Sensors come
before human cameras, since the two see different objects and cannot be drawn at once, and are handed over
as soon as they are there. No more than 15 rounds a second are made, and after each there is a pause in
proportion, so that the browser on the same machine gets its share.

A camera that is being dragged is another matter: somebody follows it with the hand. Its picture is made next and
alone (`hurry`), without a pause, and the others when it rests.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from workbench.core.camera_settings import CameraKey
from workbench.core.pictures import CameraKind, Picture
from workbench.core.take_pictures import KINDS, BegunPictures, Request, begin_pictures
from workbench.core.task_env import TaskEnv

_PERIOD = 1 / 15
_PAUSE_SHARE = 0.3
"""Of the time a round took."""


class PictureMaker:
    """Rounds of pictures of what `watch` named; `poll` moves the present one on."""

    def __init__(self) -> None:
        self._env_index = 0
        self._requests: tuple[Request, ...] = ()
        self._wanted = False
        self._hurried: set[CameraKey] = set()
        self._next_round = 0.0
        self._round: tuple[Request, ...] = ()
        self._begun: BegunPictures | None = None
        self._begun_at = 0.0
        self._ready_at = 0.0
        self._kinds_left: list[CameraKind] = []
        self._round_began = 0.0
        self._expected: dict[tuple[CameraKey, ...], float] = {}
        self._drawn: tuple[CameraKey, ...] = ()
        self.nothing_else_to_do = False
        """No step is due: a picture is waited for where it is not ready, since guessing when it will be takes longer."""
        self._moment = 0
        self._begun_of = 0
        self.moments: list[int] = []
        """Which moment (as `scene_changed` was told) each of the pictures that were fetched last shows."""

    def watch(self, env_index: int, requests: Sequence[Request]) -> None:
        """From now on these cameras of this env."""
        self._env_index, self._requests = env_index, tuple(requests)
        self._wanted = bool(requests)
        self._hurried.clear()
        self._expected.clear()
        self._next_round = 0.0  # somebody waits for these

    def scene_changed(self, moment: int) -> None:
        """What was drawn is old; the scene is now that of `moment`, a number of the caller's."""
        self._wanted, self._moment = bool(self._requests), moment

    def hurry(self, key: CameraKey) -> None:
        """Somebody moves this camera: if it is watched, its picture comes first."""
        if any((kind, name) == key for name, kind, _ in self._requests):
            self._hurried.add(key)

    @property
    def idle(self) -> bool:
        """Whether the renderer is at work on nothing of ours."""
        return self._begun is None

    def wait(self, now: float) -> float | None:
        """Seconds until `poll` has something to do; None while nobody looks."""
        if self._begun is not None:
            return 0.0 if self.nothing_else_to_do else max(0.0, self._ready_at - now)
        if self._hurried:
            return 0.0
        return max(0.0, self._next_round - now) if self._wanted else None

    def poll(self, env: TaskEnv, now: float) -> tuple[tuple[Picture, ...], float] | None:
        """Begin or fetch what is due; the pictures of a kind and their seconds when they are complete."""
        if self._begun is None:
            if not self._hurried and (not self._wanted or now < self._next_round):
                return None
            if self._hurried:
                self._round = tuple(r for r in self._requests if (r[1], r[0]) in self._hurried)
                self._hurried.clear()
            else:
                self._round, self._wanted = self._requests, False
            self._round_began = now
            self._kinds_left = [kind for kind in KINDS if any(r[1] == kind for r in self._round)]
            self._begin_next(env)
            return None
        if now < self._ready_at and not self.nothing_else_to_do:
            return None
        made, seconds = self._fetch()
        if self._kinds_left:
            self._begin_next(env)
        else:
            done = time.monotonic()
            pause = _PAUSE_SHARE * (done - self._round_began)
            self._next_round = max(self._round_began + _PERIOD, done + pause)
        return made, seconds

    def settle(self) -> None:
        """Wait for the renderer and give up the round: the scene is about to be closed or drawn anew."""
        if self._begun is not None:
            self._begun.finish()
            self._begun = None
            self._wanted = bool(self._requests)

    def _begin_next(self, env: TaskEnv) -> None:
        kind = self._kinds_left.pop(0)
        chosen = [request for request in self._round if request[1] == kind]
        self._begun = begin_pictures(env.env, self._env_index, chosen)
        self._drawn = tuple((kind, name) for name, kind, _ in chosen)
        self._begun_of = self._moment
        self._begun_at = time.monotonic()
        self._ready_at = self._begun_at + self._expected.get(self._drawn, 0.0)

    def _fetch(self) -> tuple[tuple[Picture, ...], float]:
        begun, self._begun = self._begun, None
        assert begun is not None
        asked = time.monotonic()
        made = tuple(begun.finish())
        self.moments = [self._begun_of] * len(made)
        done = time.monotonic()
        waited = done - asked > 0.004
        # Fetched too early, the wait tells how long it takes; otherwise it may take less than expected.
        took = done - self._begun_at
        self._expected[self._drawn] = min(took, 1.0) if waited else 0.9 * self._expected.get(self._drawn, 0.0)
        return made, took
