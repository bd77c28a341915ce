"""Arguments that the command line turns into something else."""

from __future__ import annotations

import pytest

from workbench.task_arguments import Rules, history_bytes, task_options


@pytest.mark.parametrize(
    ("text", "size"), [("256MB", 2**28), ("2gb", 2**31), (" 1.5 G ", 3 * 2**29), ("1048576", 2**20)]
)
def test_a_size_is_read_as_people_write_it(text: str, size: int) -> None:
    assert history_bytes(text) == size


@pytest.mark.parametrize("rules", ["stop", "warn", "off", None])
def test_the_degree_of_the_rules_is_an_option_of_the_task(rules: Rules) -> None:
    assert task_options(4, "cpu", 0, (), rules).rules == rules


@pytest.mark.parametrize("text", ["", "0", "many", "-3MB", "12XB", "1e9MB", "10", "nan GB", "9" * 400 + "GB"])
def test_a_size_that_is_none_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match="such as 256MB or 2GB"):
        history_bytes(text)
