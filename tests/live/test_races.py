"""Concurrent commands all count, and a single failure affects nothing else."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from tests.drive.session import FakeWorker, fake_worker_session
from tests.drive.waiting import until
from workbench.live.commands import PauseRun, ResetAll, Step
from workbench.live.messages import Play, Request, Reset, Settings, SingleStep
from workbench.machine.processes.watched_thread import listen, stop_listening


class FailsOnce(FakeWorker):
    """Fails on the first request of one kind."""

    fails: type[Request] | None = None

    def send(self, request: Request) -> None:
        if self.fails is not None and isinstance(request, self.fails):
            self.fails = None
            raise OSError("no more memory")
        super().send(request)


def test_an_effect_that_fails_once_is_reported_and_affects_nothing_else(tmp_path: Path) -> None:
    said: list[str] = []
    listen(said.append)
    try:
        with fake_worker_session(tmp_path, worker=FailsOnce) as fake:
            worker = fake.worker
            assert isinstance(worker, FailsOnce)
            fake.play(2)
            fake.asked(object)
            worker.fails = SingleStep
            with pytest.raises(OSError, match="no more memory"):
                fake.session.do(Step())
            assert not fake.view.playing, "it pauses first"
            fake.session.do(Step())
            assert len(fake.asked(SingleStep)) == 1
            fake.session.do(ResetAll())
            assert len(fake.asked(Reset)) == 1
            # A failed effect of a worker's event ends neither the worker nor the other effects.
            assert said == []
            worker.fails = Settings
            fake.load("rebuilt")
            assert len(said) == 1 and "no more memory" in said[0]
            assert fake.view.task_serial == 2 and fake.replaced == 0
            fake.step()
            assert fake.view.problem is None
    finally:
        stop_listening(said.append)


def test_a_worker_that_floods_steps_does_not_delay_a_press(tmp_path: Path) -> None:
    with fake_worker_session(tmp_path) as fake:
        fake.play(1)
        ends = threading.Event()

        def flood() -> None:
            while not ends.is_set():
                fake.step()

        flooding = threading.Thread(target=flood, daemon=True)
        flooding.start()
        until(lambda: fake.view.timeline.last > 100, "the flood")
        fake.asked(object)
        taken = threading.Event()

        def press() -> None:
            fake.session.do(PauseRun())
            taken.set()

        threading.Thread(target=press, daemon=True).start()
        assert taken.wait(5) and flooding.is_alive()
        until(lambda: any(not play.playing for play in fake.asked(Play)), "the pause")
        ends.set()
        flooding.join()
