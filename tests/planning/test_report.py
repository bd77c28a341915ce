"""What is said of the seeds that were solved, while they come in and at the end."""

from __future__ import annotations

from pathlib import Path

from workbench.planning.report import SolvedSeed, SolveReport, underway_text


def report(*solved_at: int, wanted: int, cut_off: bool = False) -> SolveReport:
    seeds = (
        SolvedSeed(seed, at, 20, 9.0, 2.0, "" if at else "stuck", Path(f"{seed}.rrd"), cut_off and not at)
        for seed, at in enumerate(solved_at)
    )
    return SolveReport(tuple(seeds), (), 61.2, False, wanted)


def test_the_summary_has_one_total_while_seeds_come_in_and_at_the_end() -> None:
    assert report(8, 0, wanted=2).summary == "Solved 1 of 2 seeds, in 8 control steps (median). 61 s."
    assert report(0, wanted=1).summary == "Solved 0 of 1 seed. 61 s."
    one = report(8, wanted=9)
    assert one.summary == "1 of 9 seeds is done, 1 solved, in 8 control steps (median). 61 s."
    assert one.so_far == "after 1 of 9 seeds" and report(8, wanted=1).so_far == ""


def test_few_seeds_and_seeds_whose_time_was_up_are_told() -> None:
    assert report(*[8] * 8, wanted=8).notes == ()
    few = report(8, 8, wanted=2)
    assert few.tells and few.notes[0].startswith("2 seeds are few:") and "fewer than 8" in few.notes[0]
    begun = report(8, wanted=9)
    assert not begun.tells and "from 3 seeds on" in begun.notes[0]
    (cut,) = report(*[8] * 8, 0, wanted=9, cut_off=True).notes
    assert cut.startswith("1 seed ended because its time was up: on another machine")


def test_the_seeds_under_way_are_told_with_their_steps() -> None:
    assert underway_text({}, 50) == ""
    assert underway_text({2: 12}, 50) == "seed 2 at step 12 of 50"
    assert underway_text({3: 7, 2: 12}, 50) == "seeds 2 and 3 at steps 12 and 7 of 50"
    assert underway_text({4: 1, 3: 7, 2: 12}, 50) == "seeds 2, 3 and 4 at steps 12, 7 and 1 of 50"
