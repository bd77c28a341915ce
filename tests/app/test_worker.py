"""The worker's loop in the test's process, on a task whose envs end at different steps; the test is its server."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np
import pytest

from tests.drive.session import TASKS
from tests.drive.waiting import TIMEOUT_SECONDS
from workbench.app.worker.main_loop import Worker
from workbench.envs.inspection import Inspection
from workbench.envs.maniskill_private import mark_camera_configs
from workbench.envs.task_drawings import drawings
from workbench.live.messages import (
    Answer,
    Event,
    Inspect,
    Load,
    Loaded,
    MoveBody,
    Play,
    Quit,
    Reset,
    SetCapture,
    SetSliderAction,
    Settings,
    SingleStep,
    SliderAction,
    Status,
    TaskFailed,
)
from workbench.live.process.heartbeat import INTERRUPT_SIGNAL, HeartbeatWriter
from workbench.machine.processes.wire import Call, MessageSocket
from workbench.task.description import Stepped, TaskOptions

pytestmark = [pytest.mark.thorough, pytest.mark.usefixtures("clean_process")]

Kind = TypeVar("Kind")
OPTIONS = TaskOptions(3, seed=4, env_kwargs={"render_backend": "none"})
LIMIT = 4
TEXT = (
    (TASKS / "minimal.py")
    .read_text()
    .replace("max_episode_steps=50", f"max_episode_steps={LIMIT}")
    .replace("WorkbenchMinimal-v1", "WorkerLoop-v1")
    .replace("        p = torch.tensor([0, 0, 0.03], device=self.device).repeat(len(env_idx), 1)\n", "        p = torch.rand((len(env_idx), 3)) * 0.01\n        p[:, 2] = 0.03\n")
)  # fmt: skip


class Server:
    """The server's end of the connection."""

    def __init__(self, line: socket.socket) -> None:
        self._line = MessageSocket(line, get_args(Event), ())
        self.events: list[Any] = []
        """All events so far."""

    def send(self, *requests: Any) -> None:
        for request in requests:
            self._line.send(request)

    def until(self, kind: type[Kind], fits: Callable[[Kind], object] = lambda event: True) -> Kind:
        """The next event of this kind that fits."""
        deadline = time.monotonic() + TIMEOUT_SECONDS
        while (event := self._line.receive(max(deadline - time.monotonic(), 0.0))) is not None:
            self.events.append(event)
            if isinstance(event, kind) and fits(event):
                return event
        came = [type(event).__name__ for event in self.events[-9:]]
        raise AssertionError(f"no such {kind.__name__} came, but {came}")

    def step(self, count: int = 1) -> Stepped:
        """The result of the last of these single steps."""
        for _ in range(count):
            self.send(SingleStep())
            found = self.until(Stepped)
        return found

    def answer(self, question: Any) -> Answer:
        self.send(Call(7, question))
        found = self.until(Answer)
        assert found.number == 7
        return found


def work_for(serve: Callable[[Server], None]) -> None:
    """Run a worker, with `serve` in a thread as its server; an exception of `serve` is raised here."""
    ours, theirs = socket.socketpair()
    heartbeat = os.memfd_create("heartbeat")
    os.truncate(heartbeat, 4096)
    failed: list[BaseException] = []
    server = Server(ours)

    def run() -> None:
        try:
            serve(server)
        except BaseException as error:
            failed.append(error)
        finally:
            server.send(Quit())
            while not over.is_set():  # a full socket would block the worker
                server._line.receive(0.1)

    over = threading.Event()
    thread = threading.Thread(target=run, daemon=True)
    handler, drawn_before = signal.getsignal(INTERRUPT_SIGNAL), drawings.on
    thread.start()
    mark_camera_configs()  # as `work` does: a name of ManiSkill that changes later needs a new process
    try:
        Worker(theirs.detach(), HeartbeatWriter(heartbeat)).run()
    finally:
        over.set()
        thread.join()
        signal.signal(INTERRUPT_SIGNAL, handler)
        drawings.on = drawn_before
    if failed:
        raise failed[0]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    file = tmp_path / "task.py"
    file.write_text(TEXT)
    return file


def mask(*envs: int) -> list[bool]:
    return [env in envs for env in range(3)]


def test_each_env_ends_and_is_reset_at_its_own_step(file: Path) -> None:
    def serve(server: Server) -> None:
        server.send(Load(str(file), OPTIONS, number=1))
        loaded = server.until(Loaded)
        assert loaded.task.num_envs == 3 and loaded.reload is None and loaded.task.geometry.visuals
        first = server.until(Stepped)
        assert first.reset_mask.all() and first.seeds is not None and first.seeds.tolist() == [4, 5, 6]
        assert (first.step.elapsed_steps == 0).all() and not first.resumed
        second = server.step()
        assert not second.reset_mask.any() and (second.step.elapsed_steps == 1).all() and second.acted_by
        server.send(Reset((1,), 11))
        reset = server.until(Stepped)
        assert reset.reset_mask.tolist() == mask(1) and reset.step.elapsed_steps.tolist() == [1, 0, 1]
        assert reset.seeds is not None and reset.seeds[1] == 11
        ended = server.step(LIMIT - 1)
        assert ended.step.truncated.tolist() == mask(0, 2)
        again = server.until(Stepped)
        assert again.reset_mask.tolist() == mask(0, 2) and again.step.elapsed_steps.tolist() == [0, 3, 0]
        assert again.seeds is not None and len({*again.seeds[[0, 2]].tolist(), 4, 5, 6, 11}) == 6
        server.send(Settings(episode_end="continue"))
        assert server.step().step.truncated.tolist() == mask(1)
        assert server.step().step.elapsed_steps.tolist() == [2, 5, 2], "nothing was reset"
        seeds = set[int]()
        for _ in range(2):
            server.send(Reset((0, 2)))
            fresh = server.until(Stepped)
            assert fresh.reset_mask.tolist() == mask(0, 2) and fresh.seeds is not None
            seeds |= {*fresh.seeds[[0, 2]].tolist()}
        assert len(seeds) == 4, "each reset without a seed has new ones"
        # A reset with the same seed repeats the episode, its random actions too.
        episodes = []
        for _ in range(2):
            server.send(Reset(None, 20))
            start = server.until(Stepped)
            episodes.append([start.step.poses, *(server.step().step.action for _ in range(2))])
        for one, other in zip(*episodes, strict=True):
            np.testing.assert_array_equal(one, other)
        assert len({row.tobytes() for row in episodes[0][1]}) == 3

    work_for(serve)


def test_playing_pauses_at_an_end_or_by_a_single_step(file: Path) -> None:
    def serve(server: Server) -> None:
        server.send(Play(True, 2))
        assert not server.until(Status, lambda status: status.handled == 2).playing, "no task is loaded"
        server.send(Settings(speed=float("inf"), episode_end="pause"), Load(str(file), OPTIONS))
        server.until(Loaded)
        server.until(Stepped)
        server.send(Play(True, 3))
        assert server.until(Status, lambda status: status.handled == 3).playing
        ends = server.until(Stepped, lambda event: event.step.truncated.all())
        assert ends.step.elapsed_steps.tolist() == [LIMIT] * 3
        paused = server.until(Status, lambda status: not status.playing)
        assert (paused.steps_per_second, paused.real_time_factor, paused.handled) == (0.0, 0.0, 3)
        server.send(Settings(speed=0.01, episode_end="reset"), Reset(None, 1), Play(True, 4), SingleStep())
        assert not server.until(Status, lambda status: status.handled == 4 and not status.playing).playing
        assert server.until(Stepped, lambda event: not event.reset_mask.any()).step.elapsed_steps.max() >= 1
        server.send(Play(True, 1))
        assert server.until(Status, lambda status: status.playing).handled == 4, "an older press"

    work_for(serve)


def test_sliders_move_only_their_envs(file: Path) -> None:
    def serve(server: Server) -> None:
        server.send(Load(str(file), OPTIONS))
        server.until(Stepped)
        server.send(Settings(action_source="sliders"))
        held = server.until(SliderAction).action
        for wrong in (SetSliderAction((3,), (0,), (0.5,)), SetSliderAction((0,), (99,), (0.5,))):
            server.send(wrong)  # of a version with more envs, and of another robot
        server.send(SetSliderAction((0, 2), (1,), (0.5,)))
        moved = server.until(SliderAction).action
        wanted = held.copy()
        wanted[[0, 2], 1] = 0.5
        np.testing.assert_allclose(moved, wanted, atol=1e-6)
        stepped = server.step()
        assert stepped.step.action is not None
        np.testing.assert_allclose(stepped.step.action, wanted, atol=1e-6)
        server.until(SliderAction)
        server.send(Settings(action_source="random"))
        assert server.step().acted_by != stepped.acted_by

    work_for(serve)


def test_a_recorded_env_starts_from_its_own_seed_alone(file: Path) -> None:
    def serve(server: Server) -> None:
        server.send(Load(str(file), OPTIONS))
        server.until(Stepped)

        def start_of(env: int, reset: Reset) -> np.ndarray:
            server.send(reset)
            return server.until(Stepped).step.poses[env]

        alone = start_of(1, Reset((1,), 31))
        together = start_of(1, Reset(None, 30))
        assert not np.array_equal(alone, together), "they share their random numbers"
        server.send(SetCapture((1,), from_reset=True))
        np.testing.assert_array_equal(start_of(1, Reset(None, 30)), alone)
        np.testing.assert_array_equal(start_of(1, Reset((0, 1), 30)), alone)

    work_for(serve)


def test_a_save_that_fails_keeps_the_version_and_the_next_one_goes_on(file: Path) -> None:
    def serve(server: Server) -> None:
        server.send(Load(str(file), OPTIONS, number=1))
        server.until(Loaded)
        server.until(Stepped)
        moved = server.step()
        file.write_text(TEXT + "\nclass (\n")
        server.send(Load(str(file), OPTIONS, number=2))
        failed = server.until(TaskFailed)
        assert failed.kept and not failed.at_run and failed.problem.stage == "syntax" and not failed.spoiled
        assert (server.step().step.elapsed_steps == 2).all()
        file.write_text(TEXT.replace("> 0.05", "> -1"))
        server.send(Load(str(file), OPTIONS, number=3))
        patched = server.until(Loaded)
        assert patched.reload is not None and patched.reload.level == "patched"
        assert patched.task.geometry.visuals == () and patched.first.evaluate["success"].all()
        after = server.step()
        assert (after.step.elapsed_steps == 3).all() and after.step.evaluate["success"].all()
        file.write_text(TEXT.replace("half_size=[0.03] * 3", "half_size=[0.02] * 3"))
        server.send(Load(str(file), OPTIONS, number=4))
        rebuilt = server.until(Loaded)
        assert (
            rebuilt.reload is not None and rebuilt.reload.level == "rebuilt" and rebuilt.task.geometry.visuals
        )
        again = server.until(Stepped)
        assert again.reset_mask.all() and not again.resumed
        assert moved.number < after.number < again.number

    work_for(serve)


def test_a_version_of_which_code_ran_before_it_failed_ends_the_process(file: Path) -> None:
    def serve(server: Server) -> None:
        server.send(Load(str(file), OPTIONS))
        server.until(Stepped)
        file.write_text(TEXT + "\nraise OSError('broken')\n")
        server.send(Load(str(file), OPTIONS))
        failed = server.until(TaskFailed)
        assert failed.kept and failed.spoiled and "broken" in failed.problem.message

    work_for(serve)


def test_a_hook_that_fails_pauses_and_is_reported_each_time(file: Path) -> None:
    bad = TEXT.replace(
        '        return {"success"',
        "        if self.elapsed_steps.max() > 2:\n            raise KeyError('goal')\n        return {\"success\"",
    )

    def serve(server: Server) -> None:
        file.write_text(bad)
        server.send(Settings(speed=float("inf")), Load(str(file), OPTIONS))
        server.until(Loaded)
        server.until(Stepped)
        for _ in range(2):
            server.send(Play(True))
            failed = server.until(TaskFailed)
            assert (
                failed.at_run
                and failed.kept
                and failed.problem.line == bad.splitlines().index("            raise KeyError('goal')") + 1
            )
            server.send(Reset(None, 1))
            assert server.until(Stepped).reset_mask.all()
        assert not [one for one in server.events if isinstance(one, Status)][-1].playing

    work_for(serve)


def test_questions_are_answered_or_refused_with_a_reason(file: Path) -> None:
    def serve(server: Server) -> None:
        assert server.answer(Reset(None, 1)).why
        server.send(Load(str(file), OPTIONS))
        server.until(Stepped)
        answered = server.answer(Reset(None, 1))
        assert answered.value and not answered.why and answered.problem is None
        server.send(Inspect(3, ("state",)), Inspect(2, ("state",), "cube"))
        read = server.until(Inspection)
        assert read.env == 2 and read.state and read.body is not None
        place = (0.3, 0.2, 0.5, 1.0, 0.0, 0.0, 0.0)
        server.send(MoveBody("cube", (1,), place, 5))
        moved = server.until(Stepped)
        assert moved.restored is not None and moved.restored.moved and moved.acted_by == ""
        assert moved.reset_mask.tolist() == mask(1) and moved.restored.env_idx == (1,)
        cube = [(abs(row[:, :3] - place[:3]) < 1e-4).all(axis=1).any() for row in moved.step.poses]
        assert cube == mask(1)

    work_for(serve)
