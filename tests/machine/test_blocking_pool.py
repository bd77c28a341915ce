"""Blocking calls beside the loop."""

from __future__ import annotations

from concurrent.futures import Future

from tests.drive.waiting import TIMEOUT_SECONDS
from workbench.machine.loop import BlockingPool, submit


def test_a_pool_that_is_closed_while_its_first_call_begins_runs_or_cancels_that_call() -> None:
    """As when the session ends just after a save began."""

    async def begin(pool: BlockingPool) -> Future[int]:
        return pool.begin(lambda: 1)

    for _ in range(300):
        pool = BlockingPool("test")
        began = submit(begin(pool))
        pool.close()
        call = began.result(TIMEOUT_SECONDS)
        assert call.cancelled() or call.result(TIMEOUT_SECONDS) == 1
