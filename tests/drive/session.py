"""A session with a real worker process on a real task, and what tests ask of one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.drive.waiting import until
from workbench.jobs.task import TaskOptions
from workbench.session.live.session import Session
from workbench.session.live.view import SessionView
from workbench.session.process.supervisor import WorkerOptions
from workbench.session.rescore.background import RescoreView
from workbench.session.rescore.recordings import Rescorer

TASKS = Path(__file__).parents[2] / "tasks"


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


def wait_until(session: Session, reached: Callable[[SessionView], bool], what: str) -> SessionView:
    """The first snapshot for which `reached` holds."""

    def seen() -> str:
        view = session.view()
        return f"state {view.state}, problem {view.problem}, {view.printed.texts[-10:]}"

    def wanted() -> SessionView | None:
        view = session.view()
        return view if reached(view) else None

    return until(wanted, what, seen=seen)


def step(session: Session, count: int = 1) -> SessionView:
    """Control steps of all envs, one by one."""
    view = session.view()
    for _ in range(count):
        # Not by what is shown: that changes too when a look at the past ends.
        last = session.view().timeline.last
        session.step()
        view = wait_until(session, lambda view, n=last: view.timeline.last > n, "a step")
    return view


def start_over(session: Session, seed: int) -> SessionView:
    """Paused at the first moment of new episodes of all envs, live; the session's seed is this from now on."""
    session.pause()
    before = session.view().timeline.last
    session.set_seed(seed)

    def came(view: SessionView) -> bool:
        timeline = session._state.timeline
        if timeline is None or view.playing or view.timeline.last <= before:
            return False
        (moment,) = timeline.history.between(view.timeline.last, view.timeline.last)
        # By its seed: a reset that was under way comes first.
        return moment.seeds is not None and moment.seeds[0] == seed

    return wait_until(session, came, "the reset")


def rescored(rescorer: Rescorer, *states: str) -> RescoreView:
    """What a page shows of the judging of recordings once it is in one of these states."""

    def wanted() -> RescoreView | None:
        view = rescorer.rescoring.view
        return view if view.state in states else None

    return until(wanted, " or ".join(states), 120.0, seen=lambda: rescorer.rescoring.view)
