"""Segments one input as the harness of peer programs asks, so that all stand in one table.

    python run_peers.py INPUT.npz --peers seg \\
        --external 'octoseg=python tests/beside_peers.py {dir} {out} {threads}'

The harness leaves the points in DIR/points.f32 and, of scans, the stripe of every point
in DIR/line.i32. Written are OUT/labels.i32, OUT/normals.f32 and OUT/types.i32, and one line of JSON
with the seconds of the stages. Kernels are compiled by a first run, which counts as "jit". With

    PYTHONPATH=. python tests/beside_peers.py --blocks FOLDER --seeds 1000:1005 --noise 0.01

random blocks of all families are scanned and saved as inputs of the harness.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

import octoseg_ti
from octoseg_ti import Scans, SurfaceKind, segment
from octoseg_ti.device.profiling import Trace

# The harness knows four kinds of surface.
_TYPES = {
    SurfaceKind.PLANE: 0,
    SurfaceKind.CYLINDER: 1,
    SurfaceKind.CONE: 2,
    SurfaceKind.SPHERE: 3,
}
_NORMALS = ("cleaning", "normals", "measure")


def main() -> None:
    """Run as the arguments say."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("place", nargs="*", help="DIR OUT THREADS, as the harness calls")
    parser.add_argument("--blocks", type=Path, help="folder for scans of random blocks")
    parser.add_argument("--seeds", default="1000:1005", help="first and one past the last seed")
    parser.add_argument("--noise", type=float, default=0.01, help="range noise [mm]")
    options = parser.parse_args()
    if options.blocks is not None:
        first, last = map(int, options.seeds.split(":"))
        save_blocks(options.blocks, range(first, last), options.noise)
    elif len(options.place) == 3:
        answer(Path(options.place[0]), Path(options.place[1]))
    else:
        parser.error("DIR OUT THREADS or --blocks FOLDER is needed")


def answer(given: Path, out: Path) -> None:
    """Segment what the harness gives."""
    points = np.fromfile(given / "points.f32", np.float32).reshape(-1, 3).astype(np.float64)
    line = given / "line.i32"
    stripe = np.fromfile(line, np.int32) if line.is_file() else None
    scans = Scans(points=points, stripe=stripe)
    base = _memory("VmRSS")
    began = time.perf_counter()
    segment(scans)
    compiled = time.perf_counter() - began
    trace = Trace()
    result = segment(scans, trace=trace)
    labels = result.labels.copy()
    if result.fillets is not None:
        # The truth of the harness knows no fillets; which patches are strips of one is told.
        strips = np.flatnonzero(result.fillets.strip >= 0)
        labels[np.isin(labels, strips) | (result.fillets.point >= 0)] = -1
    labels.tofile(out / "labels.i32")
    result.normals.astype(np.float32).tofile(out / "normals.f32")
    types = np.array([_TYPES.get(SurfaceKind(int(k)), -1) for k in result.kind] + [-1], np.int32)
    types[labels].tofile(out / "types.i32")
    stages = [["jit", "first run", compiled]]
    for name, seconds in trace.seconds.items():
        stages.append(["normals" if name in _NORMALS else "segment", name, seconds])
    told = {
        "stages": stages,
        "n_segments": result.patch_count,
        "version": f"octoseg {octoseg_ti.__version__}",
        "base_kb": base,
        "hwm_kb": _memory("VmHWM"),
    }
    print(json.dumps(told))


def save_blocks(folder: Path, seeds: range, noise: float) -> None:
    """Scan random blocks of all families, and save them as inputs of the harness."""
    from scanner_sim import StripeScanner, simulate
    from scanner_sim.random_blocks import FAMILIES, random_block

    folder.mkdir(parents=True, exist_ok=True)
    for family in FAMILIES:
        for seed in seeds:
            scanner = StripeScanner(range_noise=noise)
            scans, truth = simulate(random_block(seed, family), scanner, seed=seed)
            points, line = _in_the_world(scans)
            assert truth.patch is not None and truth.kind is not None
            types = [_TYPES.get(SurfaceKind(int(k)), -1) for k in truth.kind]
            np.savez(
                folder / f"{family}_{seed}_{noise:g}.npz",
                points=points.astype(np.float32),
                line=line,
                labels=truth.patch,
                types=np.array(types, np.int32),
                normals=np.zeros((0, 3)) if truth.normal is None else truth.normal,
            )
    print(f"{len(seeds) * len(FAMILIES)} scans in {folder}", file=sys.stderr)


def _in_the_world(scans: Scans) -> tuple[np.ndarray, np.ndarray]:
    """Return the points in the world, and stripes numbered over all views."""
    points, stripe = scans.points, scans.stripe
    assert stripe is not None
    view = np.zeros(len(points), np.int32) if scans.view is None else scans.view
    if scans.frame == "view" and scans.T_world_view is not None:
        pose = scans.T_world_view[view]
        points = np.einsum("nij,nj->ni", pose[:, :3, :3], points) + pose[:, :3, 3]
    _, line = np.unique(np.stack([view, stripe]), axis=1, return_inverse=True)
    return points, line.ravel().astype(np.int32)


def _memory(field: str) -> int:
    """Return a figure of /proc/self/status [kB]; 0 where there is none."""
    status = Path("/proc/self/status")
    if not status.is_file():
        return 0
    return int(status.read_text().split(f"{field}:")[1].split()[0])


if __name__ == "__main__":
    main()
