"""Mutate files of every kind and have them read: ``python -m tests.fuzz --count 100000 --jobs 2``."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from contextlib import ExitStack
from itertools import takewhile
from pathlib import Path

from tests.fuzz.campaign import FINE, Tally, cases, run_all, save, shortened, single_cases
from tests.fuzz.seeds import make_seeds
from tests.fuzz.targets import TARGETS


def main() -> None:
    """Run the cases and print what became of them; status 1 where one broke something."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000, help="cases")
    parser.add_argument("--first", type=int, default=0, help="number of the first; the same numbers, the same cases")
    parser.add_argument("--single", action="store_true", help="each value of each kind of file in turn; all such cases")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after these, and say how many")
    parser.add_argument("--targets", nargs="*", default=[], choices=list(TARGETS), metavar="NAME", help="only these")
    parser.add_argument("--seeds", type=Path, help="folder to keep the seeds in, for the next time")
    parser.add_argument("--save", action="store_true", help="store what breaks in tests/fuzz/corpus")
    options = parser.parse_args()
    with ExitStack() as stack:
        seeds = options.seeds or Path(stack.enter_context(tempfile.TemporaryDirectory())) / "seeds"
        if not seeds.is_dir():
            make_seeds(seeds)
        began = time.monotonic()
        until = began + 60.0 * options.minutes
        drawn = cases(seeds, options.first, options.count, options.targets)
        every = single_cases(seeds, options.targets) if options.single else drawn
        chosen = takewhile(lambda case: time.monotonic() < until, every)
        tally = run_all(seeds, chosen, options.jobs, _Teller(began).tell)
        print(tally.table(), flush=True)
        print(f"\n{tally.count:,} cases in {time.monotonic() - began:.0f} s")
        for kind, (case, found) in tally.broken.items():
            shown = shortened(seeds, case, found) if options.save else case
            print(f"\n{kind}\n  {found['detail']}\n  {str(shown)[:600]}")
            if options.save:
                print(f"  {save(shown, found)}")
    sys.exit(1 if tally.broken else 0)


class _Teller:
    """Says on stderr how far it is, once a minute."""

    def __init__(self, began: float) -> None:
        self.began = self.told = began
        self.known = 0

    def tell(self, tally: Tally) -> None:
        now = time.monotonic()
        if len(tally.broken) > self.known:
            kind, (case, found) = list(tally.broken.items())[-1]
            print(f"{tally.count:,}: {kind}: {found['detail'][:200]} {str(case)[:300]}", file=sys.stderr, flush=True)
            self.known = len(tally.broken)
        if now - self.told > 60.0:
            self.told = now
            bad = sum(n for counter in tally.outcomes.values() for kind, n in counter.items() if kind not in FINE)
            print(f"{tally.count:,} cases in {now - self.began:.0f} s, {bad} bad", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
