"""Union-find without compare-and-swap: the larger root is hooked under the smaller by `atomic_min`.

The root of a set is its smallest member, whatever the order of the unions and the threads.
"""

from octoseg_ti.device.runtime import ti


@ti.func
def find(parent: ti.template(), start: ti.i32) -> ti.i32:
    """Return the root of a member, halving the path on the way."""
    x = start
    while parent[x] != x:
        above = parent[parent[x]]
        parent[x] = above
        x = above
    return x


@ti.func
def unite(parent: ti.template(), a: ti.i32, b: ti.i32):
    """Join the sets of two members."""
    x = find(parent, a)
    y = find(parent, b)
    while x != y:
        high = ti.max(x, y)
        low = ti.min(x, y)
        old = ti.atomic_min(parent[high], low)
        if old == high:
            x = y
        else:
            x = find(parent, old)
            y = find(parent, low)
