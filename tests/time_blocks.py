"""Times the simulation of random blocks with a line of nine rays and both shadows.

    PYTHONPATH=. python tests/time_blocks.py --seeds 0:25 --families all

prints a row for every family: seconds for a block of 90,000 points with its truth, the median of
``--repeat`` runs, after one block that compiles the kernels. It is no test: times depend on the
machine. Beside the time that passed stands that of the processor, all threads together, which tells
more where others work too. ``--points 5000000`` times larger scans.
"""

from __future__ import annotations

import argparse
import statistics
import time

from scanner_sim import StripeScanner, simulate
from scanner_sim.part import Part
from scanner_sim.random_blocks import FAMILIES, random_block


def main() -> None:
    """Simulate and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", default="0:25", help="first and one past the last seed")
    parser.add_argument("--families", default="all", help="names, separated by commas")
    parser.add_argument("--line-width", type=float, default=0.1, help="width of the line [mm]")
    parser.add_argument("--repeat", type=int, default=3, help="runs a block; their median counts")
    parser.add_argument("--points", type=int, default=90_000, help="points of a scan")
    options = parser.parse_args()
    first, last = map(int, options.seeds.split(":"))
    families = FAMILIES if options.families == "all" else options.families.split(",")
    scanner = StripeScanner(line_width=options.line_width, points=options.points)
    simulate(random_block(0, families[0]), scanner)
    heads = ("blocks", "median s", "most s", "CPU s", "most s")
    print("family    " + " ".join(f"{head:>8s}" for head in heads))
    for family in families:
        wall, work = [], []
        for seed in range(first, last):
            part = random_block(seed, family)
            runs = [_run(part, scanner, seed) for _ in range(options.repeat)]
            wall.append(statistics.median(wall for wall, _ in runs))
            work.append(statistics.median(work for _, work in runs))
        times = (statistics.median(wall), max(wall), statistics.median(work), max(work))
        print(f"{family:10s}{len(wall):8d} " + " ".join(f"{s:8.2f}" for s in times), flush=True)


def _run(part: Part, scanner: StripeScanner, seed: int) -> tuple[float, float]:
    """Return the seconds that passed and those of the processor for one scan."""
    began, used = time.perf_counter(), time.process_time()
    simulate(part, scanner, seed=seed)
    return time.perf_counter() - began, time.process_time() - used


if __name__ == "__main__":
    main()
