"""Checks random blocks and their simulated scans against plain NumPy, family by family.

    PYTHONPATH=. python tests/verify_blocks.py --seeds 0:50 --families all

prints a row for every family and a line for every block that fails, and exits with 1 if one does.
A block takes some seconds. What is checked of every block:

points    true positions lie on their surfaces and on the part; the noise is along the line of
          sight, and no more of it is beyond four sigma than the normal law leaves there
normals   true normals are the finite differences of the surfaces' distance, and point outwards
patches   every patch is connected by links along which its face goes on (union-find), and no two
          patches of one face are
counts    number and kinds of the patches are those of the construction
rays      random rays hit where all crossings and the tree of the part say; scanned points are seen
          by laser and camera, and places of a coarse scan are seen exactly when they should be
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from reference.blocks import first_hits, on_part

from octoseg_ti.types import Scans, SurfaceKind, Truth
from scanner_sim import StripeScanner, simulate
from scanner_sim.part import FlatPart, Part
from scanner_sim.quadric import distance, gradient
from scanner_sim.random_blocks import FAMILIES, describe_block, random_block
from scanner_sim.raycast import cast

_SAMPLE = 2000
_TAIL = math.erfc(4.0 / math.sqrt(2.0))  # share of a normal law beyond four sigma


class Block(NamedTuple):
    """A block, a scan of it, and what has been drawn for its checks."""

    seed: int
    family: str
    part: Part
    flat: FlatPart
    scanner: StripeScanner
    scans: Scans
    truth: Truth
    random: np.random.Generator


def scan_block(seed: int, family: str, **options: object) -> Block:
    """Return a block with a scan of it."""
    part = random_block(seed, family)
    scanner = StripeScanner(**options)  # type: ignore[arg-type]
    scans, truth = simulate(part, scanner, seed=seed)
    random = np.random.default_rng((seed, FAMILIES.index(family)))
    return Block(seed, family, part, part.flat(), scanner, scans, truth, random)


def check_points(block: Block) -> list[str]:
    """Check positions and noise."""
    truth, scans = block.truth, block.scans
    errors = []
    off = np.abs(distance(block.flat.surfaces, truth.surface, truth.position))
    if off.max() > 1e-9:
        errors.append(f"a true position is {off.max():.3g} mm off its surface")
    away = np.flatnonzero(truth.edge_distance > 0.002)
    some = block.random.choice(away, min(_SAMPLE, len(away)), replace=False)
    there = on_part(block.part, truth.position[some], truth.normal[some])
    if not there.all():
        errors.append(f"{(~there).sum()} of {len(some)} true positions are not on the part")
    pose = scans.T_world_view[scans.view]
    world = np.einsum("nij,nj->ni", pose[:, :3, :3], scans.points) + pose[:, :3, 3]
    sight = truth.position - scans.stripe_origin[scans.stripe]
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    offset = world - truth.position
    along = np.einsum("ij,ij->i", offset, sight)
    if np.abs(offset - along[:, None] * sight).max() > 1e-9:
        errors.append("noise leaves the line of sight")
    beyond = int((np.abs(along) > 4.0 * block.scanner.range_noise).sum())
    mean = _TAIL * len(along)
    if beyond > mean + 5.0 * math.sqrt(mean) + 1.0:
        errors.append(f"{beyond} points are beyond four sigma, {mean:.1f} were expected")
    if np.abs(along).max() > 7.0 * block.scanner.range_noise:
        errors.append("a point is beyond seven sigma")
    return errors


def check_normals(block: Block) -> list[str]:
    """Check normals against finite differences of the distance."""
    truth, step = block.truth, 1e-4
    slope = np.empty_like(truth.position)
    for k in range(3):
        shift = np.zeros(3)
        shift[k] = step
        high, low = (
            distance(block.flat.surfaces, truth.surface, truth.position + sign * shift)
            for sign in (1.0, -1.0)
        )
        slope[:, k] = (high - low) / (2.0 * step)
    # Which of its two sides is outside was checked with the positions.
    sign = np.sign(np.einsum("ij,ij->i", slope, truth.normal))
    worst = np.abs(sign[:, None] * slope - truth.normal).max()
    return [f"a normal is off by {worst:.3g}"] if worst > 1e-6 else []


def check_patches(block: Block) -> list[str]:
    """Check that patches are connected, and apart from each other."""
    from scipy.spatial import cKDTree

    truth = block.truth
    pitch = float(truth.info["stripe_pitch_mm"])
    reach = 4.0 * pitch
    errors = []
    trees = {}
    for k in range(truth.patch_count):
        own = np.flatnonzero(truth.patch == k)
        if len(np.unique(truth.surface[own])) != 1:
            errors.append(f"patch {k} lies on several surfaces")
            continue
        trees[k] = cKDTree(truth.position[own])
        pieces = _pieces(block, own, trees[k], reach)
        if pieces > 1:
            errors.append(f"patch {k} falls into {pieces} pieces")
    for face in np.unique(truth.surface):
        same = [k for k in trees if truth.surface[truth.patch == k][0] == face]
        for i, one in enumerate(same):
            for other in same[i + 1 :]:
                far, near = trees[one].query(trees[other].data, distance_upper_bound=reach / 2)
                close = np.argsort(far)[:20]
                close = close[np.isfinite(far[close])]
                links = np.stack([trees[one].data[near[close]], trees[other].data[close]], axis=1)
                if len(close) and _goes_on(block, int(face), links).any():
                    errors.append(f"patches {one} and {other} are one piece of a face")
    return errors


def _pieces(block: Block, own: np.ndarray, tree: object, reach: float) -> int:
    """Return into how many pieces a patch falls: union-find over links on its face."""
    truth = block.truth
    label = np.arange(len(own))
    for neighbours in (7, 31):
        count = min(neighbours, len(own))
        far, near = tree.query(truth.position[own], k=count)  # type: ignore[attr-defined]
        pairs = np.column_stack([np.repeat(np.arange(len(own)), count - 1), near[:, 1:].ravel()])
        length = far[:, 1:].ravel()
        pairs, length = pairs[length <= reach], length[length <= reach]
        # Far from all edges there is nothing that could end the face between two points.
        free = truth.edge_distance[own[pairs]].sum(axis=1) > 1.2 * length + 0.05
        label = _united(label, pairs[free])
        pairs = pairs[~free & (label[pairs[:, 0]] != label[pairs[:, 1]])]
        holds = _goes_on(block, int(truth.surface[own[0]]), truth.position[own[pairs]])
        label = _united(label, pairs[holds])
        if (label == 0).all():
            break
    return len(np.unique(label))


def _united(label: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return labels after the union of pairs of points: the lowest number of each set."""
    label = label.copy()
    while True:
        one, other = label[pairs].T
        apart = one != other
        if not apart.any():
            return label
        np.minimum.at(label, np.maximum(one, other)[apart], np.minimum(one, other)[apart])
        while (label != label[label]).any():
            label = label[label]


def _goes_on(block: Block, face: int, links: np.ndarray) -> np.ndarray:
    """Return for links (L, 2, 3) between points of a face whether it goes on between them."""
    share = np.array([0.25, 0.5, 0.75])[:, None, None]
    place = ((1.0 - share) * links[:, 0] + share * links[:, 1]).reshape(-1, 3)
    index = np.full(len(place), face)
    for _ in range(3):
        slope = gradient(block.flat.surfaces, index, place)
        place = place - distance(block.flat.surfaces, index, place)[:, None] * slope
    normal = gradient(block.flat.surfaces, index, place)
    whole = on_part(block.part, place, normal) | on_part(block.part, place, -normal)
    return whole.reshape(3, -1).all(axis=0)


def check_counts(block: Block) -> list[str]:
    """Check kinds and counts of the patches."""
    truth = block.truth
    expected = Counter(
        kind for item in describe_block(block.seed, block.family) for kind in item.kinds
    )
    found = Counter(
        SurfaceKind(int(truth.kind[truth.patch == k][0])) for k in range(truth.patch_count)
    )
    errors = []
    for kind in sorted({*expected, *found}):
        if expected[kind] != found[kind]:
            errors.append(f"{found[kind]} patches are {kind.name}, {expected[kind]} were built")
    return errors


def check_rays(block: Block, rays: int = 100) -> list[str]:
    """Check hits, and what is hidden."""
    random, truth, scans = block.random, block.truth, block.scans
    errors = []
    middle, size = block.part.box.mean(axis=0), np.ptp(block.part.box, axis=0)
    away = random.normal(size=(rays, 3))
    origins = middle + 200.0 * away / np.linalg.norm(away, axis=1, keepdims=True)
    directions = middle + random.uniform(-0.55, 0.55, (rays, 3)) * size - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    reach = np.full(rays, 1000.0)
    expected = first_hits(block.part, origins, directions, reach)
    hits = cast(block.flat, origins, directions, reach)
    wrong = ~np.isclose(hits.distance, expected, rtol=0.0, atol=1e-6)
    if wrong.any():
        errors.append(f"{wrong.sum()} of {rays} rays end elsewhere")

    some = random.choice(len(scans), rays, replace=False)
    source = scans.stripe_origin[scans.stripe[some]]
    far = np.linalg.norm(truth.position[some] - source, axis=1)
    sight = (truth.position[some] - source) / far[:, None]
    first = first_hits(block.part, source, sight, reach)
    if not np.allclose(first, far, rtol=0.0, atol=1e-6):
        errors.append("a scanned point is hidden from the laser")
    rotation = scans.T_world_view[scans.view[some], :3, :3]
    back = source + rotation @ block.scanner.camera - truth.position[some]
    length = np.linalg.norm(back, axis=1)
    back /= length[:, None]
    free = first_hits(block.part, truth.position[some] + 1e-6 * truth.normal[some], back, length)
    if np.isfinite(free).any():
        errors.append(f"{np.isfinite(free).sum()} scanned points are hidden from the camera")
    return errors + _check_hidden(block, rays)


def _check_hidden(block: Block, rays: int) -> list[str]:
    """Check for rays of a coarse scan whether they give a point."""
    pitch = 2.5
    scanner = StripeScanner(
        stripe_pitch=pitch, point_pitch=pitch, dropout=0.0, lost_ends=0.0, range_noise=0.0
    )
    scans, _ = simulate(block.part, scanner)
    views = len(scans.T_world_view)
    sources, aims, cameras, seen = [], [], [], []
    for v in range(views):
        own = scans.view == v
        local, rotation = scans.points[own], scans.T_world_view[v, :3, :3]
        on_ground = local[:, 1] / (scanner.stand_off - local[:, 2]) * scanner.stand_off
        zero = float(np.median(on_ground - pitch * scans.column[own]))
        found = set(zip(scans.stripe[own].tolist(), scans.column[own].tolist(), strict=True))
        lattice = np.column_stack([scans.stripe[own], scans.column[own]])
        low, high = lattice.min(axis=0), lattice.max(axis=0) + 1
        chosen = block.random.integers(low, high, (rays // views, 2))
        source = scans.stripe_origin[chosen[:, 0]]
        aim = np.zeros((len(chosen), 3))
        aim[:, 1], aim[:, 2] = pitch * chosen[:, 1] + zero, -scanner.stand_off
        aims.append((aim / np.linalg.norm(aim, axis=1, keepdims=True)) @ rotation.T)
        sources.append(source)
        cameras.append(source + rotation @ scanner.camera)
        seen += [(int(s), int(c)) in found for s, c in chosen]
    source, aim, camera = (np.concatenate(rows) for rows in (sources, aims, cameras))
    far = first_hits(block.part, source, aim, np.full(len(aim), 1000.0))
    hit = np.isfinite(far)
    place = source + np.where(hit, far, 0.0)[:, None] * aim
    normal = _outward(block, place, aim)
    back = camera - place
    length = np.linalg.norm(back, axis=1)
    back /= length[:, None]
    free = np.isinf(first_hits(block.part, place + 1e-6 * normal, back, length))
    steep = -np.einsum("ij,ij->i", normal, aim) - math.cos(scanner.incidence_limit)
    aside = np.einsum("ij,ij->i", normal, back) - math.cos(scanner.camera_limit)
    expected = hit & free & (steep >= 0.0) & (aside >= 0.0)
    clear = (np.abs(steep) > 1e-6) & (np.abs(aside) > 1e-6)
    wrong = (expected != np.array(seen)) & clear
    if wrong.any():
        return [f"{wrong.sum()} of {clear.sum()} coarse rays are seen, or not, without reason"]
    return []


def _outward(block: Block, place: np.ndarray, aim: np.ndarray) -> np.ndarray:
    """Return the normal of the nearest surface that bounds the part at every place."""
    surfaces = block.flat.surfaces
    best, normal = np.full(len(place), np.inf), np.zeros_like(place)
    for s in range(len(surfaces.kind)):
        index = np.full(len(place), s)
        far = np.abs(distance(surfaces, index, place))
        near = np.flatnonzero((far < 1e-5) & (far < best))
        slope = gradient(surfaces, index[near], place[near])
        slope *= -np.sign(np.einsum("ij,ij->i", slope, aim[near]))[:, None]
        bounds = on_part(block.part, place[near], slope)
        best[near[bounds]], normal[near[bounds]] = far[near[bounds]], slope[bounds]
    return normal


CHECKS: dict[str, Callable[[Block], list[str]]] = {
    "points": check_points,
    "normals": check_normals,
    "patches": check_patches,
    "counts": check_counts,
    "rays": check_rays,
}


def main() -> int:
    """Check the blocks that are asked for."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").split("\n", 1)[0],
        epilog=(__doc__ or "").split("\n", 1)[1],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--seeds", default="0:50", help="FIRST:END, END is not included")
    parser.add_argument("--families", default="all", help="names with commas between, or all")
    parser.add_argument("--points", type=int, help="points of a scan; default: as the block says")
    options = parser.parse_args()
    first, end = (int(word) for word in options.seeds.split(":"))
    families = FAMILIES if options.families == "all" else options.families.split(",")
    more = {} if options.points is None else {"points": options.points}
    failed_blocks = 0
    print(f"{'family':10}{'blocks':>8}{'patches':>9}" + "".join(f"{c:>9}" for c in CHECKS))
    for family in families:
        failed = Counter[str]()
        patches = 0
        for seed in range(first, end):
            began = time.perf_counter()
            block = scan_block(seed, family, **more)
            patches += block.truth.patch_count
            errors = {name: check(block) for name, check in CHECKS.items()}
            failed.update(name for name, lines in errors.items() if lines)
            failed_blocks += any(errors.values())
            for name, lines in errors.items():
                for line in lines:
                    print(f"random:{seed}:{family}: {name}: {line}", flush=True)
            if sys.stderr.isatty():
                taken = time.perf_counter() - began
                print(f"\r{family} {seed} {taken:.1f} s ", end="", file=sys.stderr)
        good = "".join(f"{end - first - failed[name]:>9}" for name in CHECKS)
        print(f"{family:10}{end - first:>8}{patches:>9}{good}", flush=True)
    return 1 if failed_blocks else 0


if __name__ == "__main__":
    sys.exit(main())
