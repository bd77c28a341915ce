"""Finds which drawn numbers give the x and y of a body's first position, and plans the edit of their ranges."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.hands.questions import Draw, EpisodeStart, Operand, Operation
from workbench.source.definitions import Project
from workbench.source.parsed import Place, RefusedEdit, Replacement, SourceFile, TracedValue
from workbench.source.traced_edits import Changes, list_text, number_text
from workbench.task.write_edits import FileChange, SourceEdit, check_own

Floats = NDArray[np.floating[Any]]
Range = tuple[float, float]
"""Minimum and maximum, in metres in the env's frame."""
AXES = ("x", "y")
MIN_WIDTH_METRES = 1e-3
DECIMALS = 4
_EXACT_METRES = 1e-5
"""Error of a position in single precision, and of what the author computes from it."""
_MIN_SAMPLES = 5


@dataclass(frozen=True, eq=False)
class AxisDraw:
    """The number that alone gives one coordinate of a body: coordinate = offset + slope * number in 0 to 1, in metres."""

    draw: Draw
    call: int
    """How often the call had drawn before in the reset."""
    column: int
    slope: float
    offset: float

    @property
    def range(self) -> Range:
        # Rounded to a micrometre: single precision is not exact beyond it.
        ends = [round(end, 6) + 0.0 for end in (self.offset, self.offset + self.slope)]
        return min(ends), max(ends)


@dataclass(frozen=True)
class Spawn:
    """Where resets put a body."""

    x: AxisDraw | None
    y: AxisDraw | None
    """None if no single number gives the coordinate."""
    seen: tuple[Range, Range]
    """Smallest and largest x, and y, of the resets."""

    @property
    def axes(self) -> tuple[AxisDraw | None, AxisDraw | None]:
        return self.x, self.y

    @property
    def ranges(self) -> tuple[Range | None, Range | None]:
        return tuple(None if axis is None else axis.range for axis in self.axes)  # type: ignore[return-value]


def measure_spawn(starts: Sequence[EpisodeStart], row: int) -> Spawn | None:
    """Find the drawn numbers that give the first x and y of a body.

    A number counts if the coordinate is a linear function of it in every env after every reset, so that its range is exact,
    although the resets only show some of it.

    Args:
        row: the body's place along B of the poses.

    Returns:
        None if the body is in no env.
    """
    positions = np.stack([start.poses[:, row, :2] for start in starts]).reshape(-1, 2).astype(np.float64)
    there = np.isfinite(positions).all(axis=1)
    if not there.any():
        return None
    columns = [
        (draw, call, column, numbers[:, column])
        for draw, call, numbers in _draws_of_all(starts)
        for column in range(numbers.shape[1])
    ]
    axes = [
        next(
            (
                AxisDraw(draw, call, column, *line)
                for draw, call, column, numbers in columns
                if (line := _line(numbers[there], values)) is not None
            ),
            None,
        )
        for values in positions[there].T
    ]
    x, y = ((float(values.min()), float(values.max())) for values in positions[there].T)
    return Spawn(axes[0], axes[1], (x, y))


def _draws_of_all(starts: Sequence[EpisodeStart]) -> list[tuple[Draw, int, Floats]]:
    """The draws that every reset made, with their place among the draws of the same call, and numbers (S * N, M)."""
    by_reset: list[dict[tuple[Place, int], Draw]] = []
    for start in starts:
        drawn: dict[tuple[Place, int], Draw] = {}
        counts: dict[Place, int] = {}
        for draw in start.draws:
            count = counts[draw.at] = counts.get(draw.at, 0) + 1
            drawn[draw.at, count - 1] = draw
        by_reset.append(drawn)
    found: list[tuple[Draw, int, Floats]] = []
    for key, draw in by_reset[0].items():
        numbers = [drawn[key].numbers for drawn in by_reset if key in drawn]
        if len(numbers) == len(starts) and len({rows.shape for rows in numbers}) == 1:
            found.append((draw, key[1], np.concatenate(numbers).astype(np.float64)))
    return found


def _line(numbers: Floats, values: Floats) -> tuple[float, float] | None:
    """Slope and offset if `values` are a linear function of `numbers` that is not constant; else None."""
    if len(numbers) < _MIN_SAMPLES or np.ptp(numbers) < 0.01 or np.ptp(values) < 10 * _EXACT_METRES:
        return None
    low, high = int(numbers.argmin()), int(numbers.argmax())
    slope = (values[high] - values[low]) / (numbers[high] - numbers[low])
    offset = values[low] - slope * numbers[low]
    fits = np.abs(values - (offset + slope * numbers)).max() <= _EXACT_METRES
    return (float(slope), float(offset)) if fits else None


def lines_to_copy(body: str, ranges: Sequence[Range | None]) -> str:
    """Lines that draw x and y in these ranges, for the author to copy."""
    lines = [f"# in _initialize_episode, for the position of {body}, before it is set"]
    for axis, of in enumerate(ranges):
        if of is not None:
            width, low = number_text(of[1] - of[0], DECIMALS), number_text(of[0], DECIMALS)
            lines.append(f"xyz[:, {axis}] = torch.rand(len(env_idx), device=self.device) * {width} + {low}")
    return "\n".join(lines)


# --- the edit ---------------------------------------------------------------------------------------


def plan_spawn(
    texts: Mapping[str, str], body: str, spawn: Spawn, wanted: Sequence[Range | None]
) -> SourceEdit:
    """Plan the edit that changes the ranges of a body's first x and y. Nothing is written.

    Args:
        texts: the author's files by path.
        spawn: the ranges now.
        wanted: the new range of x and of y; None keeps it.

    Raises:
        RefusedEdit: the text does not determine which numbers to change. The error has lines to copy.
    """
    try:
        return _planned(Project(texts), body, spawn, wanted)
    except RefusedEdit as refused:
        raise RefusedEdit(refused.reason, lines_to_copy(body, wanted)) from None


def _planned(project: Project, body: str, spawn: Spawn, wanted: Sequence[Range | None]) -> SourceEdit:
    changes = Changes(project)
    targets: dict[tuple[Place, int], list[tuple[AxisDraw, Range]]] = {}
    for name, axis, now, to in zip(AXES, spawn.axes, spawn.ranges, wanted, strict=True):
        if to is None or (now is not None and np.allclose(now, to, rtol=0, atol=0.5 * 10**-DECIMALS)):
            continue
        if axis is None:
            raise RefusedEdit(why_no_range(name, body))
        if to[1] - to[0] < MIN_WIDTH_METRES:
            raise RefusedEdit(f"the range of {name} must be at least 1 mm wide")
        targets.setdefault((axis.draw.at, axis.call), []).append((axis, to))
    if not targets:
        raise RefusedEdit(
            "the ranges were changed by less than the precision of the written numbers (0.1 mm)"
        )
    places = [place for place, _ in targets]
    if len(set(places)) < len(places):
        raise RefusedEdit(f"{_where(changes, places[0])} draws x and y in two calls of a loop")
    for (place, _), of_call in targets.items():
        check_own(place.file)
        _edit_draw(changes, body, of_call)
    by_file: dict[SourceFile, list[Replacement]] = {}
    for file, replacement in dict.fromkeys(changes.replacements):
        by_file.setdefault(file, []).append(replacement)
    first, *others = [FileChange(file.path, file.text, file.replaced(made)) for file, made in by_file.items()]
    for change in others:
        check_own(change.file)
    return SourceEdit(**vars(first), notes=tuple(changes.notes), settings=None, others=tuple(others))


def why_no_range(axis: str, body: str) -> str:
    """Why the range of a coordinate is not known."""
    return f"{axis} of {body} is not one uniform number that torch.rand or ManiSkill's uniform draws in your files"


def _where(changes: Changes, place: Place) -> str:
    file, node = changes.find(place)
    return f"`{file.one_line(node)}` ({file.name}, line {file.line(node)})"


def _edit_draw(changes: Changes, body: str, of_call: list[tuple[AxisDraw, Range]]) -> None:
    """Edit the expression around one call so that these coordinates get these ranges; its other columns stay."""
    draw = of_call[0][0].draw
    if not draw.simple or len({axis.column for axis, _ in of_call}) < len(of_call):
        what = "draws by itself" if not draw.simple else "gives both x and y"
        raise RefusedEdit(f"{_where(changes, draw.at)} {what}, so there are no numbers to change for {body}")
    edits = _Expression(changes, draw)
    slopes, offsets = edits.slopes.copy(), edits.offsets.copy()
    for axis, (low, high) in of_call:
        if abs(edits.slopes[axis.column]) < 1e-9:
            raise RefusedEdit(f"{_where(changes, draw.whole)} multiplies the drawn numbers by 0")
        old_slope, old_offset = edits.slopes[axis.column], edits.offsets[axis.column]
        # Later code may scale and shift the coordinate: coordinate = scale * expression + shift.
        scale = axis.slope / old_slope
        if not (draw.bounds or draw.operations) and abs(abs(scale) - 1) > 1e-4:
            raise RefusedEdit(f"{_where(changes, draw.at)} is scaled in another place")
        shift = axis.offset - scale * old_offset
        begin, end = (low, high) if axis.slope > 0 else (high, low)
        slopes[axis.column] = (end - begin) / scale
        offsets[axis.column] = (begin - shift) / scale
    edits.write(slopes, offsets)


class _Expression:
    """The arithmetic expression around a draw: slopes * numbers + offsets, each (M,) for M columns."""

    def __init__(self, changes: Changes, draw: Draw) -> None:
        self._changes, self._draw = changes, draw
        self._file, self._call = changes.find(draw.at)
        self._operands = [*draw.bounds, *(one.operand for one in draw.operations if one.operand is not None)]
        self._old = {operand: self._numbers(operand) for operand in self._operands}
        self._new: dict[Operand, Floats] = {}
        self.slopes, self.offsets = self._applied(draw.operations, *self._base())

    def _numbers(self, operand: Operand) -> Floats:
        """(M,) value of an operand. Raises RefusedEdit."""
        count = self._draw.numbers.shape[1]
        if not operand.numbers:
            raise RefusedEdit(operand.why or f"{_where(self._changes, operand.at)} is not a list of numbers")
        if len(operand.numbers) not in (1, count):
            raise RefusedEdit(f"{_where(self._changes, operand.at)} is not a number for each drawn number")
        return np.broadcast_to(np.array(operand.numbers, np.float64), count)

    def _base(self) -> tuple[Floats, Floats]:
        """Slopes and offsets before the operations."""
        count = self._draw.numbers.shape[1]
        if not self._draw.bounds:
            return np.ones(count), np.zeros(count)
        low, high = (self._old[bound] for bound in self._draw.bounds[:2])
        return high - low, low

    def _applied(
        self, operations: Sequence[Operation], slopes: Floats, offsets: Floats
    ) -> tuple[Floats, Floats]:
        for operation in operations:
            number = self._old[operation.operand] if operation.operand is not None else np.zeros(1)
            match operation.sign:
                case "+":
                    offsets = offsets + number
                case "-":
                    offsets = offsets - number
                case "from":
                    slopes, offsets = -slopes, number - offsets
                case "negated":
                    slopes, offsets = -slopes, -offsets
                case "*":
                    slopes, offsets = slopes * number, offsets * number
                case "/":
                    slopes, offsets = slopes / number, offsets / number
        return slopes, offsets

    def write(self, slopes: Floats, offsets: Floats) -> None:
        """Edit the numbers of the expression so that it has these slopes and offsets."""
        if self._draw.bounds:
            scale, shift = self._applied(self._draw.operations, np.ones(len(slopes)), np.zeros(len(slopes)))
            low, high = (offsets - shift) / scale, (offsets + slopes - shift) / scale
            if self._needs_columns(low, high):
                self._write_width(low, high)
                return
            self._new = dict(zip(self._draw.bounds, (low, high, low), strict=False))
        else:
            self._solve(slopes, offsets)
        if not all(np.isfinite(new).all() for new in self._new.values()):
            raise RefusedEdit(f"{_where(self._changes, self._draw.whole)} multiplies a sampled number by 0")
        for operands in self._by_place():
            self._write(operands)

    def _needs_columns(self, low: Floats, high: Floats) -> bool:
        """Whether ``rand * (high - low) + low`` has one number where each column needs its own."""
        one = any(len(bound.numbers) == 1 for bound in self._draw.bounds)
        return len(self._draw.bounds) == 3 and one and not (_same(low, low[:1]) and _same(high, high[:1]))

    def _write_width(self, low: Floats, high: Floats) -> None:
        """Replace ``high - low`` and ``low`` by numbers for each column."""
        file, node = self._changes.find(self._draw.bounds[0].at)
        width = file.parents[node]
        _, added = self._changes.find(self._draw.bounds[2].at)
        for old, text in ((width, self._text(high - low)), (added, self._text(low))):
            self._changes.note(f"`{file.one_line(old)}` became {text}.")
            self._changes.replace(file, old, text)

    def _solve(self, slopes: Floats, offsets: Floats) -> None:
        """Choose the last factor, and the last number that is added after it."""
        operations = self._draw.operations
        last = max((i for i, one in enumerate(operations) if one.sign in ("*", "/")), default=None)
        before = operations[:last] if last is not None else ()
        after = operations[0 if last is None else last + 1 :]
        count = np.ones(len(slopes))
        scale, shift = self._applied(before, count, 0 * count)
        sign, _ = self._applied(after, count, 0 * count)
        factor = slopes / (sign * scale)
        # What the numbers after the factor must add up to, and what they add up to now.
        wanted, now = offsets - sign * factor * shift, self._applied(after, 0 * count, 0 * count)[1]
        factor_text = ""
        if last is None:
            factor_text = "" if _same(factor, np.ones(1)) else f" * {self._text(factor)}"
        else:
            operand = operations[last].operand
            assert operand is not None, "it is a factor"
            self._new[operand] = factor if operations[last].sign == "*" else 1 / factor
        added = [i for i, one in enumerate(after) if one.operand is not None]
        added_text = ""
        if added:
            operand = after[added[-1]].operand
            assert operand is not None
            flips = sum(one.sign in ("from", "negated") for one in after[added[-1] + 1 :])
            sign = (-1) ** (flips + (after[added[-1]].sign == "-"))
            self._new[operand] = self._old[operand] + (wanted - now) * sign
        elif not _same(wanted, np.zeros(1)):
            less = bool((wanted <= 0).all())
            added_text = f" {'-' if less else '+'} {self._text(-wanted if less else wanted)}"
        whole = self._changes.find(self._draw.whole)[1]
        if whole is self._call:
            self._insert(whole, factor_text + added_text)
        else:
            self._insert(self._call, factor_text)
            self._insert(whole, added_text)

    # --- texts --------------------------------------------------------------------------------------

    def _by_place(self) -> list[list[Operand]]:
        """The operands, those that are written at the same place together."""
        found: dict[Place, list[Operand]] = {}
        for operand in self._operands:
            place = operand.at if operand.value is None else _innermost(operand.value).at
            found.setdefault(place, []).append(operand)
        return list(found.values())

    def _write(self, operands: list[Operand]) -> None:
        """Edit operands that are written at one place: there if they change alike, else where each is used."""
        wanted = [self._new.get(operand, self._old[operand]) for operand in operands]
        if all(_same(self._old[operand], new) for operand, new in zip(operands, wanted, strict=True)):
            return
        value = operands[0].value
        alike = all(_same(new, wanted[0]) for new in wanted)
        if value is not None and (
            len(operands) == 1 or (alike and not any(read.others for read in value.reads))
        ):
            if isinstance(value.value, float) and np.ptp(wanted[0]) < 0.5 * 10**-DECIMALS:
                if not self._with_other_sign(operands[0], float(wanted[0][0])):
                    self._changes.number(value, float(wanted[0][0]), DECIMALS)
                    self._changes.emit(value)
                return
            if len(value.parts) == len(wanted[0]) > 1:
                for part, number in zip(value.parts.values(), wanted[0], strict=True):
                    self._changes.number(part, float(number), DECIMALS)
                self._changes.emit(value)
                return
        for operand, new in zip(operands, wanted, strict=True):
            if not _same(self._old[operand], new):
                file, node = self._changes.find(operand.at)
                text = self._text(new)
                if not isinstance(node, ast.Constant):
                    self._changes.note(f"`{file.one_line(node)}` became {text}.")
                self._changes.replace(file, node, text)

    def _with_other_sign(self, operand: Operand, number: float) -> bool:
        """Turn ``+ 0.1`` into ``- 0.2`` or back, if the new number is negative; False if the form is another."""
        file, node = self._changes.find(operand.at)
        sum_ = file.parents[node]
        if number >= 0 or not isinstance(node, ast.Constant) or not isinstance(sum_, ast.BinOp):
            return False
        start, end = file.span(sum_.left)[1], file.span(node)[1]
        if (
            sum_.right is not node
            or not isinstance(sum_.op, ast.Add | ast.Sub)
            or "\n" in file.text[start:end]
        ):
            return False
        sign = "-" if isinstance(sum_.op, ast.Add) else "+"
        text = f" {sign} {number_text(-number, DECIMALS, file.code(node))}"
        self._changes.change(file, Replacement(start, end, text))
        return True

    def _insert(self, node: ast.expr, text: str) -> None:
        """Insert operations after an expression."""
        if not text:
            return
        start, end = self._file.inner_span(node)
        outer = self._file.parents[node]
        if isinstance(node, ast.Call) and isinstance(
            outer, ast.Attribute | ast.Subscript
        ):  # (rand(b) * 2)[0]
            self._changes.change(self._file, Replacement(start, start, "("))
            text = f"{text})"
        self._changes.change(self._file, Replacement(end, end, text))

    def _text(self, numbers: Floats) -> str:
        """One number, or a list or tensor of a number for each column."""
        if np.ptp(numbers) < 0.5 * 10**-DECIMALS:
            return number_text(float(numbers[0]), DECIMALS)
        written = list_text([float(number) for number in numbers], DECIMALS)
        if len(self._draw.bounds) == 2:
            return written  # `uniform` takes lists
        assert isinstance(self._call, ast.Call)
        module = self._file.code(self._call.func).rpartition(".")[0]
        if not module:
            self._changes.add_imports(self._file, {"torch": "import torch"})
        on_device = any(
            isinstance(outer, ast.With)
            and any("torch.device(" in self._file.code(item.context_expr) for item in outer.items)
            for outer in self._file.ancestors(self._call)
        )
        return f"{module or 'torch'}.tensor({written}{'' if on_device else ', device=self.device'})"


def _innermost(value: TracedValue) -> TracedValue:
    """The number within an expression that is edited instead of it."""
    while "of" in value.parts:
        value = value.parts["of"]
    return value


def _same(a: Floats, b: Floats) -> bool:
    """Whether numbers are written with the same digits."""
    return bool(np.abs(a - b).max() < 0.5 * 10**-DECIMALS)
