"""What ISO 19107 asks of a surface of triangles, written plainly."""

from collections import Counter, defaultdict
from collections.abc import Sequence

Triangle = Sequence[int]


def surface_faults(triangles: Sequence[Triangle]) -> list[str]:
    """Edges that run twice in one direction, vertices with several fans, and parts that are not connected."""
    following: dict[int, dict[int, int]] = defaultdict(dict)
    runs: Counter[tuple[int, int]] = Counter()
    for a, b, c in triangles:
        for p, q, r in ((a, b, c), (b, c, a), (c, a, b)):
            following[p][q] = r
            runs[p, q] += 1
    found = [f"edge {edge} runs {count} times" for edge, count in runs.items() if count > 1]
    for vertex, fan in following.items():
        at = next(iter(set(fan) - set(fan.values())), next(iter(fan)))
        met = set()
        while at in fan and at not in met:
            met.add(at)
            at = fan[at]
        if len(met) < len(fan):
            found.append(f"vertex {vertex} has several fans")
    sharing: dict[frozenset[int], list[int]] = defaultdict(list)
    for number, face in enumerate(triangles):
        for k in range(3):
            sharing[frozenset((face[k - 1], face[k]))].append(number)
    reached, waiting = {0}, [0]
    while waiting:
        face = triangles[waiting.pop()]
        near = {other for k in range(3) for other in sharing[frozenset((face[k - 1], face[k]))]} - reached
        reached |= near
        waiting.extend(sorted(near))
    return found if len(reached) == len(triangles) else [*found, "not connected"]
