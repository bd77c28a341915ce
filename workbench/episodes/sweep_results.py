"""The results of a sweep: a row for each episode in ``results.parquet``, and a summary for each point."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from workbench.episodes.row import clean_text
from workbench.machine.files import open_regular_file, replace_file

RESULTS = "results.parquet"
SET, MEAN = "set.", "mean."
"""Prefixes of the columns of values that points set, and of means over an episode."""
MAX_POINTS = 1000
MAX_NAMES = 100
"""Maximum number of names that a point sets, and of entries with a mean."""
MAX_ROWS = 1_000_000
MAX_BYTES = 256 << 20
MAX_TEXT_CHARACTERS = 2000
"""Length to which a text is cut."""
_ABOUT = b"workbench.sweep"
_FORMAT = 1
_Z = 1.959964
"""95 % of a normal distribution lies within this many standard deviations of the mean."""

T = TypeVar("T")


class NoSweep(ValueError):
    """A file does not hold the results of a sweep; the message follows the file's name."""


@dataclass(frozen=True)
class SweepEpisode:
    """An episode of a point, or the reason why there is none."""

    point: int
    """Index of the point in `SweepResults.points`."""
    seed: int
    success: bool | None = None
    """Success in any state; None if the task has no ``success``, or there is no episode."""
    success_at_end: bool | None = None
    """Success in the last state."""
    solved_at: int | None = None
    """Control steps until the first state with success."""
    steps: int | None = None
    """Control steps; None without an episode."""
    total_reward: float | None = None
    means: Mapping[str, float] = field(default_factory=dict)
    """Mean of each entry over the episode; see `Episode.means`."""
    recording: str = ""
    """Path of its .rrd, relative to the results' folder."""
    failure: str = ""
    """Why there is no episode; empty if there is one."""


@dataclass(frozen=True)
class SweepResults:
    """All rows of a sweep, with its task, actions and points."""

    task: str
    actions: str
    seeds: int
    """Number of seeds requested for each point."""
    points: tuple[Mapping[str, str], ...]
    """Values that each point sets, by name, in JSON."""
    episodes: tuple[SweepEpisode, ...]
    """Episodes ordered by point and seed."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.points[0]) if self.points else ()

    def summaries(self) -> list[PointSummary]:
        """Summary of each point, best first: by the rate of success, then by the mean return; points without an episode
        last."""
        rows: dict[int, list[SweepEpisode]] = {}
        for one in self.episodes:
            rows.setdefault(one.point, []).append(one)
        made = [_summary(k, point, rows.get(k, [])) for k, point in enumerate(self.points)]
        return sorted(made, key=lambda one: (-_or_least(one.rate), -_or_least(one.mean_return)))


@dataclass(frozen=True)
class PointSummary:
    """Statistics over the episodes of a point."""

    index: int
    values: Mapping[str, str]
    """Values that the point sets, by name, in JSON."""
    episodes: int
    solved: int | None
    """Episodes with success in any state; None for a task without ``success``."""
    solved_at_end: int | None
    """Episodes with success in their last state."""
    mean_return: float | None
    means: Mapping[str, float]
    """Mean of `SweepEpisode.means` over the episodes."""
    failed: int
    """Seeds without an episode."""
    failure: str
    """Why the first of the failed seeds has no episode; empty if each seed has one."""

    @property
    def rate(self) -> float | None:
        return self.solved / self.episodes if self.solved is not None and self.episodes else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """95 % confidence interval of the success rate."""
        return wilson(self.solved, self.episodes) if self.solved is not None and self.episodes else None


def wilson(successes: int, count: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a success rate, for `successes` out of `count`."""
    rate, part = successes / count, _Z * _Z / count
    middle = (rate + part / 2) / (1 + part)
    half = _Z / (1 + part) * math.sqrt(rate * (1 - rate) / count + part / (4 * count))
    # Exactly 0 or 1 if none or all succeeded, which rounding would miss.
    return (middle - half if successes else 0.0), (middle + half if successes < count else 1.0)


def _or_least(number: float | None) -> float:
    return -math.inf if number is None or math.isnan(number) else number


def _summary(index: int, values: Mapping[str, str], rows: Sequence[SweepEpisode]) -> PointSummary:
    ended = [row for row in rows if row.steps is not None]
    judged = [row for row in ended if row.success is not None]
    failed = [row for row in rows if row.failure]
    returns = [row.total_reward for row in ended if row.total_reward is not None]
    means: dict[str, list[float]] = {}
    for row in ended:
        for name, value in row.means.items():
            means.setdefault(name, []).append(value)
    return PointSummary(
        index,
        values,
        len(ended),
        sum(bool(row.success) for row in judged) if judged else None,
        sum(bool(row.success_at_end) for row in judged) if judged else None,
        _mean(returns) if returns else None,
        {name: _mean(values) for name, values in means.items()},
        len(failed),
        failed[0].failure if failed else "",
    )


def _mean(values: Sequence[float]) -> float:
    # Not `math.fsum`, which raises for infinities of both signs.
    return sum(values) / len(values)


def value_text(json_text: str) -> str:
    """A value that a point sets, for display: a string without its quotes, any other value as JSON."""
    try:
        value = json.loads(json_text)
    except ValueError:
        return json_text
    return value if isinstance(value, str) else json_text


# --- the file --------------------------------------------------------------------------------------------


def write_results(path: Path, results: SweepResults) -> None:
    """Write the table, replacing an existing one. Raises OSError."""
    # Arrow takes 0.2 s to import.
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = results.episodes
    columns: dict[str, Any] = {"point": pa.array([row.point for row in rows], pa.int32())}
    for name in results.names:
        of_points = _column([point[name] for point in results.points])
        columns[SET + name] = pa.array([of_points[row.point] for row in rows])
    columns["seed"] = pa.array([row.seed for row in rows], pa.int64())
    columns["success"] = pa.array([row.success for row in rows], pa.bool_())
    columns["success_at_end"] = pa.array([row.success_at_end for row in rows], pa.bool_())
    columns["solved_at"] = pa.array([row.solved_at for row in rows], pa.int32())
    columns["steps"] = pa.array([row.steps for row in rows], pa.int32())
    columns["return"] = pa.array([row.total_reward for row in rows], pa.float64())
    for name in dict.fromkeys(name for row in rows for name in row.means):
        columns[MEAN + name] = pa.array([row.means.get(name) for row in rows], pa.float64())
    columns["recording"] = pa.array([row.recording or None for row in rows], pa.string())
    columns["failure"] = pa.array([row.failure or None for row in rows], pa.string())
    about = {
        "format": _FORMAT,
        "task": results.task,
        "actions": results.actions,
        "seeds": results.seeds,
        "points": list(map(dict, results.points)),
    }
    table = pa.table(columns).replace_schema_metadata({_ABOUT: json.dumps(about).encode()})
    content = io.BytesIO()
    pq.write_table(table, content)
    replace_file(path, content.getvalue())


def _column(texts: Sequence[str]) -> list[Any]:
    """Values of these JSON texts if they fit one column type, else the texts."""
    values = [json.loads(text) for text in texts]
    for kinds in ((bool,), (int,), (int, float), (str,)):
        if all(type(value) in kinds for value in values):
            return [float(value) for value in values] if kinds == (int, float) else values
    return list(texts)


def read_results(path: Path) -> SweepResults:
    """Read results from an untrusted file. Call this only in a confined process, and validate the results
    with `clean_results`.

    Raises:
        NoSweep: it does not hold the results of a sweep.
        OSError: it cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with open_regular_file(path, MAX_BYTES) as file:
        try:
            parquet = pq.ParquetFile(file)
            about = json.loads((parquet.schema_arrow.metadata or {}).get(_ABOUT, b"null"))
            if not isinstance(about, dict) or about.get("format") != _FORMAT:
                raise NoSweep("does not hold the results of a sweep, or comes from a later version")
            names = parquet.schema_arrow.names
            if parquet.metadata.num_rows > MAX_ROWS or len(names) > 2 * MAX_NAMES + 20:
                raise NoSweep("has more rows or columns than a sweep")
            wanted = [name for name in names if not name.startswith(SET)]
            columns = parquet.read(columns=wanted).to_pydict()
            return _results(about, columns)
        except NoSweep:
            raise
        # Arrow raises OSError for bytes that are not parquet.
        except (
            pa.ArrowException,
            ValueError,
            TypeError,
            KeyError,
            AttributeError,
            RecursionError,
            OSError,
        ) as error:
            raise NoSweep(f"cannot be read ({type(error).__name__})") from error


def _results(about: Mapping[str, Any], columns: Mapping[str, Sequence[Any]]) -> SweepResults:
    means = {name[len(MEAN) :]: values for name, values in columns.items() if name.startswith(MEAN)}
    episodes = []
    for k, point in enumerate(columns["point"]):
        known = {name: float(values[k]) for name, values in means.items() if values[k] is not None}
        episodes.append(
            SweepEpisode(
                int(point),
                int(columns["seed"][k]),
                _known(bool, columns["success"][k]),
                _known(bool, columns["success_at_end"][k]),
                _known(int, columns["solved_at"][k]),
                _known(int, columns["steps"][k]),
                _known(float, columns["return"][k]),
                known,
                str(columns["recording"][k] or ""),
                str(columns["failure"][k] or "")[:MAX_TEXT_CHARACTERS],
            )
        )
    points = tuple({str(name): str(text) for name, text in point.items()} for point in about["points"])
    return SweepResults(
        str(about["task"]), str(about["actions"]), int(about["seeds"]), points, tuple(episodes)
    )


def _known(kind: Callable[[Any], T], value: Any) -> T | None:
    return None if value is None else kind(value)


def clean_results(results: SweepResults) -> SweepResults:
    """Validate results from a file: values are converted to values that a sweep could have written, and
    invalid rows are left out.

    Raises:
        NoSweep: there are no points, too many points, or points that set different names.
    """
    if not 0 < len(results.points) <= MAX_POINTS:
        raise NoSweep(f"has {len(results.points)} points, and a sweep has 1 to {MAX_POINTS}")
    names = list(results.names)[:MAX_NAMES]
    if any(list(point)[:MAX_NAMES] != names for point in results.points):
        raise NoSweep("has points that do not set the same names")
    points = tuple(
        {clean_text(name, 100): clean_text(point[name], 200) for name in names} for point in results.points
    )
    episodes = tuple(
        SweepEpisode(
            row.point,
            row.seed,
            row.success,
            row.success_at_end,
            row.solved_at,
            row.steps,
            _finite(row.total_reward),
            {
                clean_text(name, 100): value
                for name, value in list(row.means.items())[:MAX_NAMES]
                if math.isfinite(value)
            },
            row.recording if _is_inside(row.recording) else "",
            clean_text(row.failure, MAX_TEXT_CHARACTERS),
        )
        for row in results.episodes
        if 0 <= row.point < len(points) and abs(row.seed) < 2**63
    )
    return SweepResults(
        clean_text(results.task), clean_text(results.actions), results.seeds, points, episodes
    )


def _finite(number: float | None) -> float | None:
    return number if number is not None and math.isfinite(number) else None


def _is_inside(recording: str) -> bool:
    """Whether a row's path stays below the results' folder."""
    path = PurePosixPath(recording)
    plain = bool(recording) and len(recording) < MAX_TEXT_CHARACTERS and recording.isprintable()
    return plain and not path.is_absolute() and ".." not in path.parts and str(path) == recording
