"""When an element's vehicles depart: SUMO's rules for single vehicles and flows."""

from __future__ import annotations

import re
from typing import NamedTuple

from cavmarl.traffic.demand.demand_records import FLOW_EXPONENTIAL, FLOW_PROBABILITY, FLOW_REGULAR
from cavmarl.traffic.demand.element import MAX_TIME_MS, Element

DAY_MS = 86_400_000  # SUMO lets flows without an end last so long
MIN_RATE = 1e-12  # 1/s: less is never
MAX_NUMBER = 1 << 40  # of a flow without a number: beyond every cap

_EXPONENTIAL = re.compile(r"exp\(([^()]*)\)")
_PER_HOUR = ("vehsPerHour", "perHour")
_RATES = ("period", *_PER_HOUR, "probability")


class Timing(NamedTuple):
    """Fields of ELEMENT, in its order."""

    pattern: int
    begin_ms: int
    end_ms: int
    period_ms: int
    number: int
    rate: float

    def expected(self, begin_ms: int, end_ms: int) -> float:
        """How many vehicles depart in a span of time, in the mean."""
        span = max(min(self.end_ms, end_ms) - max(self.begin_ms, begin_ms), 0)
        if self.pattern != FLOW_REGULAR:
            return min(span / 1000.0 * self.rate, float(self.number))
        if self.period_ms == 0:
            return float(self.number)
        return float(min(-(-span // self.period_ms), self.number))


def single_timing(depart_ms: int) -> Timing:
    return Timing(FLOW_REGULAR, depart_ms, depart_ms + 1, 1, 1, 0.0)


def flow_timing(element: Element, horizon_ms: int) -> Timing:
    """The timing of a <flow>.

    `horizon_ms`: end of the simulation, where the flow names none; -1: a day after its begin.

    Raises:
        DemandError: no rate or too many, a rate that is not positive, an end before the begin.
    """
    rates = [key for key in _RATES if key in element.attrs]
    if len(rates) > 1:
        raise element.error(f"has {' and '.join(rates)}", "leave one of them")
    if not rates and "number" not in element.attrs:
        raise element.error("has no rate", f"give it one of {', '.join(_RATES)} or number")
    if rates and "number" in element.attrs and "end" in element.attrs:
        raise element.error(f"has {rates[0]}, number and end", "leave two of them")
    begin = element.time_ms("begin", 0)
    default_end = begin + DAY_MS if horizon_ms < 0 else max(horizon_ms, begin)
    end = element.time_ms("end", default_end)
    if end < begin:
        raise element.error("ends before it begins", "let end be after begin")
    number = element.whole("number", MAX_NUMBER, least=0)
    if not rates:
        period = (end - begin) // max(number, 1)
        # The last one departs before the end, whatever was lost in rounding.
        return Timing(FLOW_REGULAR, begin, max(end, begin + 1), period, number, 0.0)
    if "number" in element.attrs:
        end = MAX_TIME_MS
    return Timing(*_rate(element, rates[0], begin, end, number))


def _rate(
    element: Element, key: str, begin: int, end: int, number: int
) -> tuple[int, int, int, int, int, float]:
    exponential = _EXPONENTIAL.fullmatch(element.attrs[key].strip()) if key == "period" else None
    if exponential:
        rate = element.saying(period=exponential[1]).number("period", 0.0, above=MIN_RATE)
        return FLOW_EXPONENTIAL, begin, end, 0, number, rate
    if key == "probability":
        chance = element.number(key, 0.0, above=MIN_RATE, most=1.0)
        return FLOW_PROBABILITY, begin, end, 0, number, chance
    if key == "period":
        period = element.time_ms(key)
    else:
        period = int(min(3_600_000.0 / element.number(key, 0.0, above=0.0) + 0.5, MAX_TIME_MS))
    if period <= 0:
        raise element.error(
            f"has {key}='{element.attrs[key]}'", "one vehicle a millisecond is most"
        )
    return FLOW_REGULAR, begin, end, period, number, 0.0
