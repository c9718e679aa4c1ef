"""``python -m faults.random_schedules``: fly many random schedules and say which of them violated anything.

A seed that is printed flies the same mission again, byte for byte: ``--first SEED --seeds 1 --verbose``.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

from faults.schedule import FLIGHT_S, Schedule, schedule
from faults.trial import Outcome, fly

HELD, VIOLATED = 0, 1
"""Exit codes."""


def outcome_of(seed: int) -> Outcome:
    with TemporaryDirectory() as folder:
        return fly(schedule(seed), Path(folder))


def report(planned: Schedule, outcome: Outcome, *, verbose: bool) -> str:
    """What is to be read about one schedule."""
    lines = [str(outcome), *(f"  VIOLATION: {violation}" for violation in outcome.violations)]
    if verbose or outcome.violations:
        lines.insert(1, f"  {planned}")
    return "\n".join(lines)


def summary(outcomes: Iterable[tuple[Schedule, Outcome]], wall_s: float) -> str:
    outcomes = list(outcomes)
    kinds = Counter(event.kind for planned, _ in outcomes for event in planned.events)
    violated = sum(bool(outcome.violations) for _, outcome in outcomes)
    nearest_m = min((outcome.separation_m for _, outcome in outcomes), default=0.0)
    jumps = sum(outcome.jumps for _, outcome in outcomes)
    equal = sum(outcome.comparison is not None and outcome.comparison.bit_equal for _, outcome in outcomes)
    return (
        f"{len(outcomes)} schedules of {FLIGHT_S:g} s in {wall_s:.0f} s: {violated} with violations\n"
        f"smallest separation {nearest_m:.3f} m, {jumps} jumps, replicas bit-equal in {equal}\n"
        f"faults: {', '.join(f'{count} {kind}' for kind, count in kinds.most_common())}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m faults.random_schedules", description=__doc__)
    parser.add_argument("--seeds", type=int, default=200, help="how many")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    parser.add_argument("--workers", type=int, default=2, help="processes that fly them")
    parser.add_argument("--verbose", action="store_true", help="show the faults of every schedule")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    began, outcomes = time.perf_counter(), []
    with ProcessPoolExecutor(arguments.workers) as pool:
        for outcome in pool.map(outcome_of, seeds):
            planned = schedule(outcome.seed)
            outcomes.append((planned, outcome))
            print(report(planned, outcome, verbose=arguments.verbose), flush=True)
    print(summary(outcomes, time.perf_counter() - began))
    return VIOLATED if any(outcome.violations for _, outcome in outcomes) else HELD


if __name__ == "__main__":
    sys.exit(main())
