"""The one way for tests into a session: open one, do what a page does, see what a page sees.

`live_session` has a real worker on a real task. The worker of `told_session` is the test, which says what a worker would
say: no process, no renderer. Both give the same `Session`; what looks behind its public methods is here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tests.drive.scenes import camera as scene_camera
from tests.drive.scenes import description, step_of, table_scene
from tests.drive.waiting import until
from workbench.app.session import Session
from workbench.cameras.view import StudioCamera, StudioView
from workbench.checks.profile import ProfileJobs
from workbench.checks.state import CheckJobs
from workbench.envs.camera_data import CameraKey
from workbench.envs.step_result import StepResult
from workbench.live.commands import PauseRun, SetSeed, Step
from workbench.live.events import MomentShown, PastPicturesWanted
from workbench.live.history.moments import History, Moment
from workbench.live.messages import Event, Inspect, Loaded, ReloadReport, Request, Status
from workbench.live.process.supervisor import Death, End, ProcessMemory, Supervisor, WorkerOptions
from workbench.live.timeline_commands import StepBack, StepForward
from workbench.live.view import SessionView
from workbench.rescore.recording_jobs import Rescorer
from workbench.rescore.state import BeginRescoring, RescoreEffect, RescoreView
from workbench.task.description import Restored, Stepped, TaskDescription, TaskOptions

TASKS = Path(__file__).parents[2] / "tasks"
BASE: CameraKey = ("sensor", "base_camera")
PEOPLE: CameraKey = ("human", "render_camera")
Kind = TypeVar("Kind")


# --- open ----------------------------------------------------------------------------------------------


@contextmanager
def live_session(
    task: Path | str,
    recordings: Path,
    num_envs: int = 2,
    seed: int = 0,
    draw: bool = False,
    worker: WorkerOptions | None = None,
    **env_kwargs: object,
) -> Iterator[Session]:
    """A session at the first moment of the task, closed afterwards; who opens one asks for the fixture `child_process`.

    Args:
        draw: with a renderer, for whose shaders every worker takes some seconds.
    """
    if not draw:
        env_kwargs = {"render_backend": "none", **env_kwargs}
    options = TaskOptions(num_envs=num_envs, seed=seed, env_kwargs=env_kwargs)
    session = Session(str(task), options, recordings=recordings, worker=worker)
    try:
        wait_until(session, lambda view: view.timeline.moments == 1, "the first moment")
        yield session
    finally:
        session.close()


class ToldWorker:
    """Takes the place of `Supervisor`: keeps what it is sent."""

    pid = None
    load_pending = False
    vitals = ProcessMemory()

    def __init__(self, options: WorkerOptions, warm_up: object, **callbacks: Any) -> None:
        self.first_requests: Callable[[], list[Request]] = callbacks["first_requests"]
        self.on_event: Callable[[Event], None] = callbacks["on_event"]
        self.on_death: Callable[[Death], None] = callbacks["on_death"]
        self.sent: list[Request] = []
        self.replaced = 0

    def start(self) -> None:
        """The first requests are asked for by `SliderAction.greet`."""

    def send(self, request: Request) -> None:
        self.sent.append(request)

    def replace(self) -> None:
        self.replaced += 1

    def interrupt(self) -> None:
        """It is never at anything."""

    def reset_deaths(self) -> None:
        """It never dies by itself."""

    def stop(self) -> None:
        """It has no thread."""


class Told:
    """A session, what its worker was asked (`asked`), and what it says (`tell`)."""

    def __init__(self, session: Session, worker: ToldWorker) -> None:
        self.session, self._worker = session, worker
        self.rescored: list[object] = []
        """Loads with which the past was to be rescored; no process does it."""
        session._past_rescorer.perform = self._rescore
        self._elapsed = np.zeros(0, np.int32)
        self._number = 0

    @property
    def view(self) -> SessionView:
        return self.session.view()

    @property
    def replaced(self) -> int:
        """How often another worker was asked for."""
        return self._worker.replaced

    def asked(self, kind: type[Kind]) -> list[Kind]:
        """All requests of this kind since this was called last, with any kind."""
        sent = self._worker.sent[:]
        self._worker.sent.clear()
        return [request for request in sent if isinstance(request, kind)]

    def _rescore(self, effect: RescoreEffect) -> None:
        if isinstance(effect, BeginRescoring):
            self.rescored.append(effect.load)

    def greet(self) -> list[Request]:
        """What a new worker is sent first."""
        return self._worker.first_requests()

    def tell(self, *events: Event) -> None:
        for event in events:
            self._worker.on_event(event)

    def die(self, death: Death | None = None) -> None:
        self._worker.on_death(DEATH if death is None else death)

    def load(
        self, level: str | None = None, num_envs: int = 3, same_scene: bool = False, **changes: Any
    ) -> None:
        """The worker says that a version was loaded.

        Args:
            level: of its reload; None for the first version, and for one that was brought back.
            changes: fields of its `TaskDescription`.
        """
        options = changes.pop("options", None)
        geometry, poses = table_scene(num_envs)
        task: TaskDescription = replace(description(geometry, (scene_camera(),)), **changes)
        report: Any = None if level is None else ReloadReport(level, "", same_scene=same_scene)  # type: ignore[arg-type]
        if level not in ("same", "patched", "cameras") or not len(self._elapsed):
            self._elapsed = np.zeros(num_envs, np.int32)
        first = replace(step_of(poses, success=np.zeros(num_envs, bool)), elapsed_steps=self._elapsed)
        self.tell(Loaded(task, first, {"import": 1.0}, report, options))

    def step(self, count: int = 1, **more: Any) -> None:
        """Control steps of all envs; `more` as `moment` takes it."""
        for _ in range(count):
            self._elapsed = self._elapsed + 1
            self._add(moment(self._elapsed, number=self._number, **more))

    def reset(self, envs: Sequence[int] | None = None, **more: Any) -> None:
        """A reset of these envs, or of all."""
        envs = range(len(self._elapsed)) if envs is None else envs
        self._jump(envs, np.zeros(len(envs), np.int32), **more)

    def back(self, envs: tuple[int, ...], source: tuple[int, ...], origin: int, **restored: Any) -> None:
        """These envs go to where those were at the moment of this serial."""
        at = moment_at(self.session, origin)
        undoes, success = restored.pop("undoes", None), restored.pop("success", ())
        told = Restored(envs, source, origin, undoes, restored.pop("not_carried", {}), **restored)
        elapsed = np.ones(len(envs), np.int32) if at is None else at.step.elapsed_steps[list(source)]
        self._jump(envs, elapsed, restored=told, success=success)

    def resume(self) -> None:
        """Another worker goes on at the moment of the last."""
        self._jump(range(len(self._elapsed)), self._elapsed, resumed=True)

    def play(self, steps: int) -> None:
        """It was loaded, plays, and took so many steps after a reset of all."""
        self.load()
        self.reset()
        self.step(steps)
        self.tell(Status(True, 20.0, 1.0))

    def _jump(self, envs: Sequence[int], elapsed: NDArray[np.int32], **more: Any) -> None:
        self._elapsed = self._elapsed.copy()
        self._elapsed[list(envs)] = elapsed
        self._add(moment(self._elapsed, tuple(envs), number=self._number, **more))

    def _add(self, event: Stepped) -> None:
        self._number += 1
        self.tell(event)


@contextmanager
def told_session(
    recordings: Path,
    task: Any = "push.py",
    num_envs: int = 3,
    worker: type[ToldWorker] = ToldWorker,
    **more: Any,
) -> Iterator[Told]:
    """Without a process: see `SliderAction`. `more` as `Session` takes it."""
    made: list[ToldWorker] = []

    def make_worker(*arguments: Any, **named: Any) -> Supervisor:
        made.append(worker(*arguments, **named))
        return made[-1]  # type: ignore[return-value]

    session = Session(task, TaskOptions(num_envs), recordings=recordings, make_worker=make_worker, **more)
    try:
        yield Told(session, made[0])
    finally:
        session.close()


DEATH = Death("was killed by SIGSEGV", End.DIED, "stepping", "", False)


def moment(
    elapsed: NDArray[np.int32],
    jumped: tuple[int, ...] = (),
    success: tuple[int, ...] = (),
    fail: tuple[int, ...] = (),
    truncated: tuple[int, ...] = (),
    number: int = 0,
    reward: Sequence[float] | None = None,
    evaluate: dict[str, NDArray] | None = None,
    **more: Any,
) -> Stepped:
    """What a worker tells of a step, with poses and actions that tell moments and envs apart."""
    count = len(elapsed)
    poses = _poses(count).copy()
    poses[..., 0] = np.arange(count)[:, None] + number / 1000
    masks = [np.isin(np.arange(count), list(envs)) for envs in (success, fail, truncated, jumped)]
    entries: dict[str, Any] = {"success": masks[0], "fail": masks[1]} if evaluate is None else evaluate
    step = StepResult(
        elapsed_steps=elapsed.astype(np.int32),
        reward=np.array(elapsed if reward is None else reward, np.float32),
        terminated=masks[0] | masks[1],
        truncated=masks[2],
        evaluate=entries,
        poses=poses,
        action=None if jumped else np.arange(count * 2, dtype=np.float32).reshape(count, 2) + 100 * number,
    )
    return Stepped(step, masks[3], number=number, **{"snapshot": b"body %d" % number, **more})


@cache
def _poses(count: int) -> NDArray[np.float32]:
    return table_scene(count)[1]


# --- do ------------------------------------------------------------------------------------------------


def step(session: Session, count: int = 1) -> SessionView:
    """Control steps of all envs, one by one."""
    view = session.view()
    for _ in range(count):
        # Not by what is shown: that changes too when a look at the past ends.
        last = session.view().timeline.last
        session.do(Step())
        view = wait_until(session, lambda view, n=last: view.timeline.last > n, "a step")
    return view


def start_over(session: Session, seed: int) -> SessionView:
    """Paused at the first moment of new episodes of all envs, live; the session's seed is this from now on."""
    session.do(PauseRun())
    before = session.view().timeline.last
    session.do(SetSeed(seed=seed))

    def came(view: SessionView) -> bool:
        if view.playing or view.timeline.last <= before:
            return False
        newest = moment_at(session, view.timeline.last)
        # By its seed: a reset that was under way comes first.
        return newest is not None and newest.seeds is not None and newest.seeds[0] == seed

    return wait_until(session, came, "the reset")


def save(session: Session, file: Path, text: str) -> SessionView:
    """Save the file, and wait until this text is what runs."""
    file.write_text(text)
    return runs(session, text)


def runs(session: Session, text: str) -> SessionView:
    """The view as soon as this text is what runs, at rest in its first moment or on."""

    def reached(view: SessionView) -> bool:
        return (
            view.task is not None
            and text in view.task.source.values()
            and view.problem is None
            and not view.stale
            and view.state in ("paused", "running")
        )

    return wait_until(session, reached, "the saved version")


def jump(session: Session, ask: Callable[[], object]) -> SessionView:
    """The view once the jump that `ask` asks for has come."""
    last = session.view().timeline.last
    ask()
    return wait_until(session, lambda v: v.timeline.last > last, "the jump")


def seek(session: Session, serial: int | None) -> None:
    """Show the moment of this serial; live if None."""
    session.happen(MomentShown(serial))


def seek_by(session: Session, steps: int) -> None:
    """Press the right arrow so often, or the left one."""
    for _ in range(abs(steps)):
        session.do(StepForward() if steps > 0 else StepBack())


def heard(session: Session) -> SessionView:
    """The view once the worker has answered a question, after all that it was sent before."""
    before = session.view().inspection
    session._worker.send(Inspect(0, ("joints",)))
    return wait_until(session, lambda view: view.inspection is not before, "an answer of the worker")


def draw_past(session: Session) -> None:
    """Draw at once what the shown moment lacks, as it is drawn when a slider stands still."""
    session.happen(PastPicturesWanted(session.look(lambda run: run.stands_at)))


def stop_watching(session: Session) -> None:
    """Saves are noticed no more."""
    session._watcher.stop()


# --- see -----------------------------------------------------------------------------------------------


def wait_until(session: Session, reached: Callable[[SessionView], object], what: str) -> SessionView:
    """The first snapshot for which `reached` holds."""

    def seen() -> str:
        view = session.view()
        return f"state {view.state}, problem {view.problem}, {view.printed.texts[-10:]}"

    def wanted() -> SessionView | None:
        view = session.view()
        return view if reached(view) else None

    return until(wanted, what, seen=seen)


def history_of(session: Session) -> History:
    """All that it keeps of the running scene."""
    past = session.look(lambda run: run.past)
    assert past is not None
    return past.history


def moment_at(session: Session, serial: int) -> Moment | None:
    """What the session keeps of a moment."""
    past = session.look(lambda run: run.past)
    return None if past is None else past.history.at(serial)


def moments_of(session: Session) -> list[Moment]:
    """All that it keeps, oldest first."""
    view = session.view().timeline
    found = (moment_at(session, serial) for serial in range(view.first, view.last + 1))
    return [one for one in found if one is not None]


def work_with(session: Session, background: Any) -> None:
    """Rules are checked and steps are timed by this, in place of a process."""
    session._checks = CheckJobs(background, session._happen)
    session._profiles = ProfileJobs(background, session._happen)


def background_pid(session: Session) -> int | None:
    """Of the process that rescores, checks and draws the past."""
    return session._background.pid


def moved(view: SessionView) -> set[CameraKey]:
    """Cameras that are placed otherwise than in the file."""
    return {camera.key for camera in view.of(StudioView).cameras if camera.moved}


def camera(session: Session, key: CameraKey) -> StudioCamera:
    found = session.view().of(StudioView).camera(key)
    assert found is not None
    return found


def in_studio(what: Callable[[StudioView], object]) -> Callable[[SessionView], object]:
    return lambda view: what(view.of(StudioView))


def rescored(rescorer: Rescorer, *states: str) -> RescoreView:
    """What a page shows of the judging of recordings once it is in one of these states."""

    def wanted() -> RescoreView | None:
        view = rescorer.view
        return view if view.state in states else None

    return until(wanted, " or ".join(states), 120.0, seen=lambda: rescorer.view)
