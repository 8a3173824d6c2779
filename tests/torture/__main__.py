"""Prints a table of faults: tried, survived, work lost, something else wrong. Linux only.

PYTHONPATH=tests python -m torture          about 8 minutes; exit status 1 if anything is lost
PYTHONPATH=tests python -m torture --long   10,000 fuzzed cases, 600 kills
"""

import argparse
import faulthandler
import logging
import shutil
import sys
import tempfile
import time
from pathlib import Path

import torch as th

from torture import crash, fuzz, hub, soak, untrusted


def trials(folder, long):
    """All lines of the table, one after the other."""

    def place():
        return Path(tempfile.mkdtemp(dir=folder))

    yield from crash.torture(place(), 600 if long else 100, 50 if long else 8)
    yield from untrusted.torture(place(), long)
    yield from hub.torture(place())
    yield from soak.torture(place(), 2000 if long else 200)
    yield from fuzz.torture(place(), 10_000 if long else 1500)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--long", action="store_true", help="take an hour")
    args = parser.parse_args()
    faulthandler.dump_traceback_later(7200 if args.long else 900, exit=True)
    logging.disable()
    th.set_num_threads(1)
    folder, start = Path(tempfile.mkdtemp(prefix="torture-")), time.monotonic()
    row = "{:<42}{:>8}{:>10}{:>6}{:>7}{:>9}".format
    print(row("fault", "tried", "survived", "lost", "wrong", "seconds"))
    found = []
    for outcome in trials(folder, args.long):
        seconds = round(time.monotonic() - start)
        print(row(*outcome[:2], outcome.survived, outcome.lost, outcome.wrong, seconds), flush=True)
        for note in outcome.notes:
            print(f"    {note}", flush=True)
        found.append(outcome)
    sums = [
        sum(getattr(each, name) for each in found)
        for name in ("tried", "survived", "lost", "wrong")
    ]
    print(row("all", *sums, round(time.monotonic() - start)))
    shutil.rmtree(folder, ignore_errors=True)
    sys.exit(int(sums[2] + sums[3] > 0))


if __name__ == "__main__":
    main()
