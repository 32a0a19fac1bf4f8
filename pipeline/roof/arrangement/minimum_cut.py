"""Labels of least cost on a graph: alpha expansion, every expansion an exact minimum cut.

The cost of labels is a sum over nodes and over edges whose ends differ (the Potts model). An expansion lets every node
keep its label or take alpha, at the least cost of all such moves (Boykov, Veksler and Zabih 2001); the move is a
minimum cut of a graph with two terminals (Kolmogorov and Zabih 2004), found by Dinic's maximum flow (1970).
Costs are integers: sums and cuts are exact and do not depend on any order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import counting_sort
from pipeline.model import IntArray, LabelArray


class Neighbours(NamedTuple):
    """The edges of every node of a graph of n nodes and m edges, in compressed rows."""

    starts: LabelArray
    """(n + 1,) int32, first entry of every node."""
    others: LabelArray
    """(2 m,) int32, the node at the other end."""
    weights: IntArray
    """(2 m,) int64, cost of the edge."""


class Allowed(NamedTuple):
    """The nodes that can take each of k labels."""

    nodes: LabelArray
    """(m,) int32, label after label, ascending in each."""
    starts: LabelArray
    """(k + 1,) int32, first entry of every label."""


class Costs(NamedTuple):
    """Costs of k labels at n nodes, of which few differ from the node's usual one, in compressed rows.

    A hall with hundreds of planes has hundreds of thousands of places, and few planes explain anything at one of them.
    """

    starts: IntArray
    """(n + 1,) int64, first entry of every node."""
    labels: LabelArray
    """(m,) int32, labels with a cost of their own, ascending at each node."""
    costs: IntArray
    """(m,) int64, their costs."""
    others: IntArray
    """(n,) int64, cost of every other label."""


@kernel
def costs_of_all(costs: IntArray) -> Costs:
    """Costs (n, k) in compressed rows, all of them."""
    n, k = costs.shape
    labels, starts = np.empty(n * k, np.int32), np.empty(n + 1, np.int64)
    for i in range(n + 1):
        starts[i] = i * k
    for s in range(n * k):
        labels[s] = s % k
    return Costs(starts, labels, costs.ravel(), np.zeros(n, np.int64))


@kernel
def cost_of(costs: Costs, node: int, label: int) -> int:
    """Cost of a label at a node."""
    usual: int = costs.others[node]
    first = costs.starts[node]
    # labels ascend: so many can precede this one at most
    last = min(costs.starts[node + 1], first + label + 1)
    for s in range(last - 1, first - 1, -1):
        if costs.labels[s] == label:
            own: int = costs.costs[s]
            return own
    return usual


class _Flow(NamedTuple):
    """A graph with capacities: n nodes, the source n and the sink n + 1. Arcs a and a ^ 1 are each other's reverse."""

    first: LabelArray
    """(n + 2,) int32, first arc of every node."""
    following: LabelArray
    """(a,) int32, the next arc of the same node, or -1."""
    target: LabelArray
    """(a,) int32, the node that each arc leads to."""
    capacity: IntArray
    """(a,) int64, what each arc can still take."""
    distance: LabelArray
    """(n + 2,) int32, arcs from the source; after `_cut` 0 at nodes from which the sink can be reached, else -1."""


class _Moves(NamedTuple):
    """Working space of an expansion, (n,) for n nodes."""

    number: LabelArray
    """int32, number among the nodes that may change; -1 for the others."""
    change: IntArray
    """int64, by how much the cost of a node changes with its label."""
    queue: LabelArray
    """int32."""
    bound: IntArray
    """int64, sum of the weights at each node."""


@kernel
def neighbour_lists(n: int, edges: IntArray, weights: IntArray) -> Neighbours:
    """The edges of n nodes in compressed rows, from pairs (m, 2) int64 and their costs (m,) int64."""
    nodes = np.empty(2 * len(edges), np.int32)
    for e in range(len(edges)):
        nodes[2 * e], nodes[2 * e + 1] = edges[e, 0], edges[e, 1]
    starts, ends = counting_sort(nodes, n)
    others = np.empty(2 * len(edges), np.int32)
    costs = np.empty(2 * len(edges), np.int64)
    for s in range(len(ends)):
        others[s] = nodes[ends[s] ^ 1]
        costs[s] = weights[ends[s] // 2]
    return Neighbours(starts, others, costs)


@kernel
def _distances(flow: _Flow, n: int) -> bool:
    """Breadth-first distances from the source over arcs with capacity; whether the sink is reached."""
    distance = flow.distance
    distance[: n + 2] = -1
    queue = np.empty(n + 2, np.int32)
    queue[0] = n
    distance[n] = 0
    head = 0
    tail = 1
    while head < tail:
        node = queue[head]
        head += 1
        arc = flow.first[node]
        while arc >= 0:
            other = flow.target[arc]
            if flow.capacity[arc] > 0 and distance[other] < 0:
                distance[other] = distance[node] + 1
                queue[tail] = other
                tail += 1
            arc = flow.following[arc]
    return bool(distance[n + 1] >= 0)


@kernel
def _cut(flow: _Flow, n: int) -> None:
    """Saturate the graph by Dinic's algorithm; afterwards `distance` is 0 on the sink's side of a minimum cut, else -1.

    Of several minimum cuts this is the one nearest to the sink: no node takes a new label that costs the same as its
    own.
    """
    first, following, target, capacity, distance = flow
    current = np.empty(n + 2, np.int32)
    path = np.empty(n + 2, np.int32)
    while _distances(flow, n):
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


@kernel(inline="always")
def _mark_movable(
    costs: Costs, nodes: LabelArray, neighbours: Neighbours, labels: LabelArray, alpha: int, moves: _Moves
) -> None:
    """Give the number 0 to the nodes, among those given, that can take alpha in a minimum cut.

    A node keeps its label if alpha does not make it cheaper even where all its neighbours that may still change take
    it: the minimum cut wanted is the one in which the fewest nodes change. This can settle its neighbours in turn.
    Nearly every node is settled without a flow. `moves.number` is -1 everywhere before.
    """
    starts, others, weights = neighbours
    number, change, queue, bound = moves
    asked = 0
    for p in nodes:
        if labels[p] == alpha:
            continue
        cost = cost_of(costs, p, alpha) - cost_of(costs, p, labels[p])
        if cost < bound[p]:
            number[p], change[p] = 0, cost
            queue[asked] = p
            asked += 1
    # those that keep their label take the places of nodes that were looked at
    tail = 0
    for s in range(asked):
        p = queue[s]
        own, cost = labels[p], change[p]
        for e in range(starts[p], starts[p + 1]):
            r = others[e]
            # a neighbour with alpha differs from the node's own label
            takes = (number[r] >= 0) | (labels[r] == alpha)
            cost += weights[e] * ((not takes) & (labels[r] == own)) - weights[e] * takes
        change[p] = cost
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
            change[r] += weights[e] if labels[p] != labels[r] else 2 * weights[e]
            if change[r] >= 0:
                number[r] = -1
                queue[tail] = r
                tail += 1


@kernel(inline="always")
def _add_arc(flow: _Flow, arc: int, tail: int, head: int, capacity: int) -> None:
    """Add an arc from node to node, and its reverse without capacity."""
    flow.target[arc] = head
    flow.capacity[arc] = capacity
    flow.following[arc] = flow.first[tail]
    flow.first[tail] = arc
    flow.target[arc + 1] = tail
    flow.capacity[arc + 1] = 0
    flow.following[arc + 1] = flow.first[head]
    flow.first[head] = arc + 1


@kernel(inline="always")
def _build_flow(
    costs: Costs,
    nodes: LabelArray,
    neighbours: Neighbours,
    labels: LabelArray,
    alpha: int,
    moves: _Moves,
    active: int,
    flow: _Flow,
) -> bool:
    """The graph whose minimum cut is the best expansion of alpha (Kolmogorov and Zabih 2004); whether one can gain."""
    starts, others, weights = neighbours
    number, unary = moves.number, moves.change
    flow.first[: active + 2] = -1
    arcs = 0
    unary[:active] = 0
    for p in nodes:
        i = number[p]
        if i < 0:
            continue
        cost = cost_of(costs, p, alpha) - cost_of(costs, p, labels[p])
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
                _add_arc(flow, arcs, i, j, 2 * weights[e] - apart)
                arcs += 2
        unary[i] += cost
    gain = False
    for i in range(active):
        if unary[i] != 0:
            # a positive cost of alpha binds the node to the source: it keeps its label; a negative one to the sink
            tail, head = (active, i) if unary[i] > 0 else (i, active + 1)
            gain = gain or unary[i] < 0
            _add_arc(flow, arcs, tail, head, abs(unary[i]))
            arcs += 2
    return gain


@kernel
def expand_labels(costs: Costs, allowed: Allowed, neighbours: Neighbours, labels: LabelArray, rounds: int) -> None:
    """Lower the cost of labels, in place, by expansions of every label in turn until none helps.

    `costs` are those of every label at every node. There are at most so many `rounds` through all labels.
    """
    n, k = len(costs.others), len(allowed.starts) - 1
    n_arcs = 2 * (len(neighbours.others) // 2 + n)
    flow = _Flow(
        np.empty(n + 2, np.int32),
        np.empty(n_arcs, np.int32),
        np.empty(n_arcs, np.int32),
        np.empty(n_arcs, np.int64),
        np.empty(n + 2, np.int32),
    )
    moves = _Moves(np.full(n, -1, np.int32), np.empty(n, np.int64), np.empty(n, np.int32), np.zeros(n, np.int64))
    for i in range(n):
        for e in range(neighbours.starts[i], neighbours.starts[i + 1]):
            moves.bound[i] += neighbours.weights[e]
    quiet = 0
    turn = 0
    while quiet < k and turn < rounds * k:
        alpha = turn % k
        turn += 1
        quiet += 1
        nodes = allowed.nodes[allowed.starts[alpha] : allowed.starts[alpha + 1]]
        _mark_movable(costs, nodes, neighbours, labels, alpha, moves)
        active = 0
        for p in nodes:
            if moves.number[p] >= 0:
                moves.number[p] = active
                active += 1
        if active == 0:
            continue
        gain = _build_flow(costs, nodes, neighbours, labels, alpha, moves, active, flow)
        if gain:
            _cut(flow, active)
        for p in nodes:
            if gain and moves.number[p] >= 0 and flow.distance[moves.number[p]] == 0:
                labels[p] = alpha
                quiet = 0
            moves.number[p] = -1


@kernel(inline="always")
def every_label(n: int, k: int) -> Allowed:
    """The lists of `expand_labels` where every node can take every label."""
    nodes = np.empty(n * k, np.int32)
    starts = np.empty(k + 1, np.int32)
    for label in range(k + 1):
        starts[label] = label * n
    for label in range(k):
        for i in range(n):
            nodes[label * n + i] = i
    return Allowed(nodes, starts)
