"""Which episodes are kept, whatever the order in which they end."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from workbench.session.dealer import Dealer


@given(
    wanted=st.integers(1, 5),
    most=st.none() | st.integers(1, 30),
    good=st.lists(st.booleans(), min_size=40, max_size=40),
    slots=st.integers(1, 8),
    data=st.data(),
)
def test_the_kept_successes_are_those_with_the_lowest_numbers(
    wanted: int, most: int | None, good: list[bool], slots: int, data: st.DataObject
) -> None:
    most = min(most or len(good), len(good))
    first = [index for index in range(most) if good[index]][:wanted]
    dealer = Dealer(wanted, only_successes=True, most=most)
    running: list[int] = []
    kept: list[int] = []
    dropped: list[int] = []
    while True:
        while len(running) < slots and (index := dealer.next()) is not None:
            running.append(index)
        for index, keep in dealer.decided():
            if index in running:
                assert not keep
                running.remove(index)
            (kept if keep else dropped).append(index)
        if not running:
            break
        index = running.pop(data.draw(st.integers(0, len(running) - 1)))
        dealer.ended(index, good[index])
    assert sorted(kept) == first
    assert len({*kept, *dropped}) == len(kept) + len(dropped)
    assert dealer.tried == (first[-1] + 1 if len(first) == wanted else most)


def test_every_episode_counts_where_no_success_is_asked_for() -> None:
    dealer = Dealer(3)
    assert [dealer.next() for _ in range(4)] == [0, 1, 2, None]
    for index in (2, 0, 1):
        dealer.ended(index, success=False)
    assert sorted(dealer.decided()) == [(0, True), (1, True), (2, True)]
