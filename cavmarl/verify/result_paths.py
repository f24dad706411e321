r"""Expressions that name numbers in the JSON of a command.

An expression is a path, such as `rows[side=libsumo].median`. A step is a key, an index, `{any key}`
or `*` for all elements; `[key=value,…]` chooses an element of a list, with braces around a value
with commas. `100 max rows.*.share` applies operations from right to left: a factor,
`min`, `max`, `mean`, `median`, `sum`, `len`, or `first` to `fourth` (elements of a list). A text
gives the numbers that it contains. `PATH / PATH` is a ratio; `PATH ; PATH` gives the first number
of each path. A metric of an evaluation gives its mean and the ends of its interval, in the unit of
the reports.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from statistics import fmean, median
from typing import Any

from cavmarl.core.errors import EvaluationError
from cavmarl.verify.published_lines import NUMBER

_STEP = re.compile(r"\{([^}]*)\}|([^.\[\]{}]+)|\[([^\]]*)\]|\.")
_CONDITION = re.compile(r"(\w+)=(\{[^}]*\}|[^,]*)")
_OPERATIONS: Mapping[str, Callable[[Sequence[float]], float]] = {
    "min": min, "max": max, "mean": fmean, "median": median, "sum": sum, "len": len,
    **{word: itemgetter(k) for k, word in enumerate(("first", "second", "third", "fourth"))},
}  # fmt: skip


def numbers_at(expression: str, document: Any) -> list[float]:
    """Return the numbers that an expression names.

    Raises:
        EvaluationError: the result does not have these numbers.
    """
    if ";" in expression:
        parts = [numbers_at(part.strip(), document) for part in expression.split(";")]
        return [part[0] for part in parts if part]
    over, is_ratio, under = expression.partition(" / ")
    found = _evaluate(over.strip(), document)
    if not is_ratio:
        return found
    below = _evaluate(under.strip(), document)
    if len(below) != 1 or below[0] == 0.0:
        raise _too_few(under, below)
    return [value / below[0] for value in found]


def _evaluate(expression: str, document: Any) -> list[float]:
    word, _, rest = expression.partition(" ")
    if rest and word in _OPERATIONS:
        values = _evaluate(rest, document)
        try:
            return [float(_OPERATIONS[word](values))]
        except (IndexError, ValueError) as error:  # `statistics` raises subclasses of ValueError
            raise _too_few(expression, values) from error
    if rest and re.fullmatch(NUMBER, word):
        return [float(word) * value for value in _evaluate(rest, document)]
    return _numbers(value_at(expression, document), expression)


def value_at(path: str, document: Any) -> Any:
    """Return the value at a path; raises EvaluationError if the result does not have it."""
    found, seen = document, ""
    for match in _STEP.finditer(path):
        quoted, plain, chosen = match.groups()
        try:
            if chosen is not None:
                found = _chosen(found, chosen)
            elif plain == "*":
                rest = path[match.end() :].lstrip(".")
                elements = found.values() if isinstance(found, Mapping) else found
                return [value_at(rest, each) if rest else each for each in elements]
            elif quoted is not None or plain is not None:
                key = quoted if quoted is not None else plain
                found = found[int(key)] if isinstance(found, list) else found[key]
        except (LookupError, TypeError, ValueError) as error:
            known = (
                ", ".join(map(str, found)) if isinstance(found, Mapping) else type(found).__name__
            )
            raise EvaluationError(
                f"the result has no {match[0]} at {seen or 'its top'} of {path!r} ({known}); "
                "correct the expression"
            ) from error
        seen += match[0]
    return found


def _chosen(rows: Any, conditions: str) -> Any:
    """Return the one element of a list that meets all conditions; raises LookupError."""
    wanted = [(key, text.strip("{}")) for key, text in _CONDITION.findall(conditions)]
    (found,) = [row for row in rows if all(_same(row[key], text) for key, text in wanted)]
    return found


def _same(value: Any, text: str) -> bool:
    if isinstance(value, str):
        return value == text
    return str(value) == text or (isinstance(value, float) and f"{value:g}" == text)


def _numbers(found: Any, path: str) -> list[float]:
    match found:
        case bool() | int() | float():
            return [float(found)]
        case str():
            return [as_number(text) for text in re.findall(NUMBER, found)]
        case list():
            return [number for each in found for number in _numbers(each, path)]
        case {"mean": mean, "within_run": runs}:
            scale = _scale_of(re.split(r"[.}]", path.rstrip("}"))[-1])
            ends = found["between_run_ci95"] or (runs[0]["wilson95"] if len(runs) == 1 else None)
            values = [mean, ends["low"], ends["high"]] if ends else [mean]
            return [] if mean is None else [scale * value for value in values]
        case None:
            return []
    raise EvaluationError(f"{path!r} is {found!r}, which is not a number; correct the expression")


def _scale_of(metric: str) -> float:
    """Return the factor by which reports show a metric."""
    from cavmarl.evaluate.metrics import METRICS  # takes seconds, and most lines do not need it

    return next(one.scale for one in METRICS if one.name == metric)


def _too_few(expression: str, values: Sequence[float]) -> EvaluationError:
    return EvaluationError(f"{expression.strip()!r} has too few numbers: {list(values)}")


def as_number(text: str) -> float:
    """Return the number that a page or a report shows."""
    return float(text.replace(",", ""))
