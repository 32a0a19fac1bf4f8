"""Labels of least cost on a graph: alpha expansion, every expansion an exact minimum cut.

The cost of labels is a sum over nodes and over edges whose ends differ (the Potts model). An expansion lets every node
keep its label or take alpha, at the least cost of all such moves (Boykov, Veksler and Zabih 2001); the move is a
minimum cut of a graph with two terminals (Kolmogorov and Zabih 2004), found by Dinic's maximum flow (1970).
Costs are integers: sums and cuts are exact and do not depend on the order of anything.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.counting_sort import counting_sort
from pipeline.model import IntArray, LabelArray


@kernel
def neighbour_lists(n: int, edges: IntArray, weights: IntArray) -> tuple[LabelArray, LabelArray, IntArray]:
    """The edges of every node in compressed rows.

    Parameters
    ----------
    n : int
        Number of nodes.
    edges : (m, 2) int64
        Pairs of nodes.
    weights : (m,) int64
        Cost of every pair.

    Returns
    -------
    starts : (n + 1,) int32
        First entry of every node.
    others : (2 m,) int32
        The node at the other end.
    costs : (2 m,) int64
        Its pair's cost.
    """
    nodes = np.empty(2 * len(edges), np.int32)
    for e in range(len(edges)):
        nodes[2 * e], nodes[2 * e + 1] = edges[e, 0], edges[e, 1]
    starts, ends = counting_sort(nodes, n)
    others = np.empty(2 * len(edges), np.int32)
    costs = np.empty(2 * len(edges), np.int64)
    for s in range(len(ends)):
        others[s] = nodes[ends[s] ^ 1]
        costs[s] = weights[ends[s] // 2]
    return starts, others, costs


@kernel
def _distances(
    first: LabelArray, following: LabelArray, target: LabelArray, capacity: IntArray, distance: LabelArray, n: int
) -> bool:
    """Breadth-first distances from the source (node n) over arcs with capacity; whether the sink (n + 1) is reached."""
    distance[: n + 2] = -1
    queue = np.empty(n + 2, np.int32)
    queue[0] = n
    distance[n] = 0
    head = 0
    tail = 1
    while head < tail:
        node = queue[head]
        head += 1
        arc = first[node]
        while arc >= 0:
            other = target[arc]
            if capacity[arc] > 0 and distance[other] < 0:
                distance[other] = distance[node] + 1
                queue[tail] = other
                tail += 1
            arc = following[arc]
    return bool(distance[n + 1] >= 0)


@kernel
def _cut(
    first: LabelArray, following: LabelArray, target: LabelArray, capacity: IntArray, distance: LabelArray, n: int
) -> None:
    """Saturate the graph; afterwards `distance` is 0 at the nodes from which the sink can still be reached, else -1.

    Arc a and a ^ 1 are each other's reverse. Of several minimum cuts this is the one nearest to the sink: no node
    takes a new label that costs the same as its own.
    """
    current = np.empty(n + 2, np.int32)
    path = np.empty(n + 2, np.int32)
    while _distances(first, following, target, capacity, distance, n):
        for k in range(n + 2):
            current[k] = first[k]
        node = n
        depth = 0
        while True:
            if node == n + 1:
                pushed = capacity[path[0]]
                for k in range(1, depth):
                    pushed = min(pushed, capacity[path[k]])
                back = 0
                for k in range(depth - 1, -1, -1):
                    capacity[path[k]] -= pushed
                    capacity[path[k] ^ 1] += pushed
                    if capacity[path[k]] == 0:
                        back = k
                node = target[path[back] ^ 1]
                depth = back
                continue
            arc = current[node]
            while arc >= 0 and (capacity[arc] == 0 or distance[target[arc]] != distance[node] + 1):
                arc = following[arc]
            current[node] = arc
            if arc >= 0:
                path[depth] = arc
                depth += 1
                node = target[arc]
            elif depth == 0:
                break
            else:
                # a dead end: no path of this round leads through it
                distance[node] = -2
                depth -= 1
                node = target[path[depth] ^ 1]
    distance[: n + 2] = -1
    distance[n + 1] = 0
    path[0] = n + 1
    head = 0
    tail = 1
    while head < tail:
        arc = first[path[head]]
        head += 1
        while arc >= 0:
            if capacity[arc ^ 1] > 0 and distance[target[arc]] < 0:
                distance[target[arc]] = 0
                path[tail] = target[arc]
                tail += 1
            arc = following[arc]


@kernel
def _number_those_that_may_change(
    costs: IntArray,
    nodes: LabelArray,
    starts: LabelArray,
    others: LabelArray,
    weights: IntArray,
    labels: LabelArray,
    alpha: int,
    number: LabelArray,
    least: IntArray,
    queue: LabelArray,
    bound: IntArray,
) -> None:
    """Mark in `number`, by 0, the nodes that can take alpha in a minimum cut; all others keep -1.

    A node that alpha does not make cheaper even if all its neighbours that are still open take it keeps its label: of
    minimum cuts the one is sought in which the fewest nodes change. So do then, perhaps, its neighbours. Nearly every
    node is settled so, without a flow.

    `least` and `queue` are room for as many numbers as there are nodes; `bound` is the sum of the weights at each.
    """
    for p in nodes:
        if labels[p] != alpha and costs[p, alpha] - costs[p, labels[p]] < bound[p]:
            number[p] = 0
    tail = 0
    for p in nodes:
        if number[p] < 0:
            continue
        cost = costs[p, alpha] - costs[p, labels[p]]
        for e in range(starts[p], starts[p + 1]):
            r = others[e]
            if number[r] >= 0:
                cost -= weights[e]
            elif labels[r] == alpha:
                cost -= weights[e]  # it differs from the node's own label
            elif labels[r] == labels[p]:
                cost += weights[e]
        least[p] = cost
        if cost >= 0:
            queue[tail] = p
            tail += 1
    for head in range(tail):
        number[queue[head]] = -1
    head = 0
    while head < tail:
        p = queue[head]
        head += 1
        for e in range(starts[p], starts[p + 1]):
            r = others[e]
            if number[r] < 0:
                continue
            # it counted on the neighbour's change: instead of w less, w more, or nothing where the labels differ anyway
            least[r] += weights[e] if labels[p] != labels[r] else 2 * weights[e]
            if least[r] >= 0:
                number[r] = -1
                queue[tail] = r
                tail += 1


@kernel
def expand_labels(
    costs: IntArray,
    allowed: LabelArray,
    allowed_starts: LabelArray,
    starts: LabelArray,
    others: LabelArray,
    weights: IntArray,
    labels: LabelArray,
    rounds: int,
) -> None:
    """Lower the cost of labels by expansions of every label in turn until none helps.

    Parameters
    ----------
    costs : (n, k) int64
        Cost of every label at every node.
    allowed, allowed_starts : (m,), (k + 1,) int32
        The nodes that can take each label, ascending, label after label.
    starts, others, weights : arrays
        The edges, from `neighbour_lists`.
    labels : (n,) int32
        Changed in place.
    rounds : int
        At most so many turns through all labels.
    """
    n, k = costs.shape
    n_arcs = 2 * (len(others) // 2 + n)
    first = np.empty(n + 2, np.int32)
    following = np.empty(n_arcs, np.int32)
    target = np.empty(n_arcs, np.int32)
    capacity = np.empty(n_arcs, np.int64)
    distance = np.empty(n + 2, np.int32)
    number = np.full(n, -1, np.int32)
    unary = np.empty(n, np.int64)
    queue = np.empty(n, np.int32)
    bound = np.zeros(n, np.int64)
    for i in range(n):
        for e in range(starts[i], starts[i + 1]):
            bound[i] += weights[e]
    quiet = 0
    turn = 0
    while quiet < k and turn < rounds * k:
        alpha = turn % k
        turn += 1
        quiet += 1
        _number_those_that_may_change(
            costs, allowed[allowed_starts[alpha] : allowed_starts[alpha + 1]], starts, others, weights, labels, alpha,
            number, unary, queue, bound,
        )  # fmt: skip
        active = 0
        for s in range(allowed_starts[alpha], allowed_starts[alpha + 1]):
            if number[allowed[s]] >= 0:
                number[allowed[s]] = active
                active += 1
        if active == 0:
            continue
        first[: active + 2] = -1
        arcs = 0
        gain = False
        unary[:active] = 0
        for s in range(allowed_starts[alpha], allowed_starts[alpha + 1]):
            p = allowed[s]
            i = number[p]
            if i < 0:
                continue
            cost = costs[p, alpha] - costs[p, labels[p]]
            for e in range(starts[p], starts[p + 1]):
                r = others[e]
                j = number[r]
                if j < 0:
                    cost += (weights[e] if labels[r] != alpha else 0) - (weights[e] if labels[r] != labels[p] else 0)
                elif p < r:
                    # E(keep, keep) = apart, E(keep, alpha) = E(alpha, keep) = w, E(alpha, alpha) = 0
                    apart = weights[e] if labels[p] != labels[r] else 0
                    cost += weights[e] - apart
                    unary[j] -= weights[e]
                    target[arcs] = j
                    capacity[arcs] = 2 * weights[e] - apart
                    following[arcs] = first[i]
                    first[i] = arcs
                    target[arcs + 1] = i
                    capacity[arcs + 1] = 0
                    following[arcs + 1] = first[j]
                    first[j] = arcs + 1
                    arcs += 2
            unary[i] += cost
        for i in range(active):
            if unary[i] == 0:
                continue
            # a positive cost of alpha binds the node to the source, who keeps; a negative one to the sink
            tail, head = (active, i) if unary[i] > 0 else (i, active + 1)
            gain = gain or unary[i] < 0
            target[arcs] = head
            capacity[arcs] = abs(unary[i])
            following[arcs] = first[tail]
            first[tail] = arcs
            target[arcs + 1] = tail
            capacity[arcs + 1] = 0
            following[arcs + 1] = first[head]
            first[head] = arcs + 1
            arcs += 2
        if gain:
            _cut(first, following, target, capacity, distance, active)
        for s in range(allowed_starts[alpha], allowed_starts[alpha + 1]):
            p = allowed[s]
            if gain and number[p] >= 0 and distance[number[p]] == 0:
                labels[p] = alpha
                quiet = 0
            number[p] = -1


@kernel(inline="always")
def every_label(n: int, k: int) -> tuple[LabelArray, LabelArray]:
    """The lists of `expand_labels` where every node can take every label."""
    allowed = np.empty(n * k, np.int32)
    starts = np.empty(k + 1, np.int32)
    for label in range(k + 1):
        starts[label] = label * n
    for label in range(k):
        for i in range(n):
            allowed[label * n + i] = i
    return allowed, starts
