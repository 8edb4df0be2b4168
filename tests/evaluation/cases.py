"""Small truths with known scores, and the five counts of a labelling."""

from types import SimpleNamespace

import numpy as np

from octoseg_ti import EdgeClass, Truth, evaluate


def blocks(*sizes):
    """Return labels 0, 1, ... of these sizes, one block after the other."""
    return np.repeat(np.arange(len(sizes)), sizes)


def five(labels, truth, overlap=0.8):
    """Return (correct, over, under, missed, noise)."""
    r = evaluate(labels, truth, overlap=overlap).regions
    return r.correct, r.over, r.under, r.missed, r.noise


def edge_case():
    """Return a row of points 1 mm apart across a sharp edge at 4.5 and a fillet at 15."""
    x = np.arange(20.0)
    sharp, fillet = np.abs(x - 4.5), np.maximum(np.abs(x - 15) - 1, 0)
    truth = Truth(
        patch=np.select([x < 4.5, fillet == 0], [0, -1], 1).astype(np.int32),
        edge_distance=np.minimum(sharp, fillet).astype(np.float32),
        edge_class=np.where(sharp < fillet, EdgeClass.SHARP, EdgeClass.FILLET).astype(np.uint8),
    )
    edge = np.zeros(20, np.uint8)
    edge[3:7] = EdgeClass.SHARP  # true within 1 mm: 4 and 5
    edge[13:16] = EdgeClass.FILLET  # true within 1 mm: 13 to 17
    labels = np.where(edge > 0, -1, (x > 4.5).astype(int))
    return SimpleNamespace(labels=labels, edge=edge, points=np.stack([x, 0 * x, 0 * x], 1)), truth
