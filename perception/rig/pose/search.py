"""Where a robot may stand and head, from the flares of its sources: compiled loops of `posterior`.

A pose is x, y, z, heading. At each heading the best place is found by Gauss–Newton, so that the posterior is
a curve over a turn, which is sampled where it is high.
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.rig.pose.problem import Problem

Array = NDArray[np.float64]

COARSE = 72
"""Headings at which the posterior is looked at first. It is a smooth function of sine and cosine."""

LEAST_COSINE = 0.5
"""A source more than 60 degrees off its bearing is not what is seen."""

TURN = 2.0 * math.pi
STEPS = 2
WITHIN, PER_SIGMA = 12, 2
WORTH_CHI2, FINEST_CHI2 = 30.0, 6.0
BISECTIONS, REFINING = 4, 8
SAME_SIGMAS, SETTLED2 = 0.1, 1e-12
WIDEST_RAD, FINEST_RAD = 0.2, 1e-7

COLUMNS = 12
"""Of a node: heading, place, χ², ln of the determinant of the place's information, half of its inverse."""


@compiled
def chi2_at(problem: Problem, pose: Array, information: Array, score: Array) -> float:
    """Return χ² at a pose, shape (4,), and write information (4, 4) and score (4,) of x, y, z, heading."""
    n = len(problem.arm_m)
    cosine, sine = math.cos(pose[3]), math.sin(pose[3])
    seen, mixed = np.empty((3 * n, 5)), np.empty(5)
    for a in range(n):
        arm_x = cosine * problem.arm_m[a, 0] - sine * problem.arm_m[a, 1]
        arm_y = sine * problem.arm_m[a, 0] + cosine * problem.arm_m[a, 1]
        x = pose[0] + arm_x - problem.origin_m[a, 0]
        y = pose[1] + arm_y - problem.origin_m[a, 1]
        z = pose[2] + problem.arm_m[a, 2] - problem.origin_m[a, 2]
        range_m = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / range_m, y / range_m, z / range_m
        axes = problem.axes[a]
        for c in range(2):
            off = axes[c, 0] * x + axes[c, 1] * y + axes[c, 2] * z
            row = 3 * a + c
            seen[row, 0] = (axes[c, 0] - off * x) / range_m
            seen[row, 1] = (axes[c, 1] - off * y) / range_m
            seen[row, 2] = (axes[c, 2] - off * z) / range_m
            seen[row, 4] = -off
        forward = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
        # Straight behind the camera both angles' sines are 0 again, which is no fit.
        if forward < LEAST_COSINE:
            seen[3 * a, 4] -= 1.0 - forward
        row = 3 * a + 2
        seen[row, 0], seen[row, 1], seen[row, 2] = x / range_m, y / range_m, z / range_m
        seen[row, 4] = problem.log_range[a] - math.log(range_m)
        for row in range(3 * a, 3 * a + 3):
            seen[row, 3] = -arm_y * seen[row, 0] + arm_x * seen[row, 1]
    chi2 = 0.0
    score[:] = 0.0
    information[:] = 0.0
    for row in range(3 * n):
        mixed[:] = 0.0
        for k in range(row + 1):
            weight = problem.white[row, k]
            for c in range(5):
                mixed[c] += weight * seen[k, c]
        chi2 += mixed[4] * mixed[4]
        for c in range(4):
            score[c] += mixed[c] * mixed[4]
            for d in range(c + 1):
                information[c, d] += mixed[c] * mixed[d]
    for c in range(4):
        for d in range(c):
            information[d, c] = information[c, d]
    return chi2


@compiled
def _solved(information: Array, score: Array, size: int, root: Array, step: Array) -> float:
    """Write the Gauss–Newton step of the first `size` unknowns; returns ln of det of the information."""
    log_determinant = 0.0
    for column in range(size):
        for row in range(column, size):
            total = information[row, column]
            for k in range(column):
                total -= root[row, k] * root[column, k]
            if row == column:
                root[column, column] = math.sqrt(max(total, 1e-300))
                log_determinant += 2.0 * math.log(root[column, column])
            else:
                root[row, column] = total / root[column, column]
    for row in range(size):
        total = score[row]
        for k in range(row):
            total -= root[row, k] * step[k]
        step[row] = total / root[row, row]
    for row in range(size - 1, -1, -1):
        total = step[row]
        for k in range(row + 1, size):
            total -= root[k, row] * step[k]
        step[row] = total / root[row, row]
    return log_determinant


@compiled
def _placed(problem: Problem, pose: Array, steps: int, node: Array) -> None:
    """Find the best place at a heading, in place; writes the node."""
    information, score, root, step = np.empty((4, 4)), np.empty(4), np.empty((4, 4)), np.empty(4)
    for _ in range(steps):
        chi2_at(problem, pose, information, score)
        _solved(information, score, 3, root, step)
        for k in range(3):
            pose[k] += step[k]
    node[0] = pose[3]
    node[1], node[2], node[3] = pose[0], pose[1], pose[2]
    node[4] = chi2_at(problem, pose, information, score)
    node[5] = _solved(information, score, 3, root, step)
    number = 6
    for c in range(3):
        score[:] = 0.0
        score[c] = 1.0
        _solved(information, score, 3, root, step)
        for d in range(c, 3):
            node[number] = step[d]
            number += 1


@compiled
def _middle(problem: Problem, pose: Array, sign: float) -> None:
    """Go from the middle of the sources to the robot's origin in place (−1), or the other way (+1)."""
    n = len(problem.arm_m)
    cosine, sine = math.cos(pose[3]), math.sin(pose[3])
    for a in range(n):
        x, y, z = problem.arm_m[a]
        pose[0] += sign * (cosine * x - sine * y) / n
        pose[1] += sign * (sine * x + cosine * y) / n
        pose[2] += sign * z / n


@compiled
def _seen_middle(problem: Problem, pose: Array) -> None:
    """Write where the middle of the flares seems to be."""
    n = len(problem.arm_m)
    pose[:3] = 0.0
    for a in range(n):
        for k in range(3):
            pose[k] += (problem.origin_m[a, k] + math.exp(problem.log_range[a]) * problem.axes[a, 2, k]) / n


@compiled
def place_node(problem: Problem) -> Array:
    """Return the node of a source that has no heading, shape (12,)."""
    pose, node = np.zeros(4), np.empty(COLUMNS)
    _seen_middle(problem, pose)
    _middle(problem, pose, -1.0)
    _placed(problem, pose, 2 * STEPS, node)
    return node


@compiled
def _gone_down(problem: Problem, coarse: Array) -> tuple[Array, Array]:
    """Return the poses at the feet of all valleys, shape (valleys, 4); χ² and σ of heading, (valleys, 2).

    The grid's poses and χ² are in `coarse`, shape (headings, 5), of what is no heading infinite. A narrow
    valley may lie between two headings, beside another: each low one's neighbours are gone down too.
    """
    count = len(coarse)
    begin = np.zeros(count, dtype=np.bool_)
    none = True
    for k in range(count):
        before, after = coarse[k - 1, 4], coarse[(k + 1) % count, 4]
        if coarse[k, 4] <= before and coarse[k, 4] < after:
            begin[k] = True
            begin[k - 1] |= math.isfinite(before)
            begin[(k + 1) % count] |= math.isfinite(after)
            none = False
    if none:  # all alike: nothing tells the heading
        begin[np.argmin(coarse[:, 4])] = True
    poses, found = np.empty((count, 4)), np.empty((count, 2))
    information, score, root, step = np.empty((4, 4)), np.empty(4), np.empty((4, 4)), np.empty(4)
    valleys = 0
    for k in range(count):
        if not begin[k]:
            continue
        pose, sigma = poses[valleys], 0.1
        pose[:] = coarse[k, :4]
        for _ in range(REFINING):
            chi2_at(problem, pose, information, score)
            for c in range(4):
                information[c, c] *= 1.0 + 1e-9
            information[3, 3] += 1e-6  # a thousand radians: where nothing tells the heading
            _solved(information, score, 4, root, step)
            sigma = 1.0 / root[3, 3]
            short = min(1.0, 0.5 * TURN / COARSE / max(abs(step[3]), 1e-12))
            worth = 0.0
            for c in range(4):
                pose[c] += short * step[c]
                worth += step[c] * score[c]
            if worth < SETTLED2:
                break
        chi2 = chi2_at(problem, pose, information, score)
        known = False
        for other in range(valleys):
            apart = (pose[3] - poses[other, 3] + 0.5 * TURN) % TURN - 0.5 * TURN
            if abs(apart) < SAME_SIGMAS * min(sigma, found[other, 1], WIDEST_RAD):
                known = True
                # Of two ends of one way down the lower is the foot.
                if chi2 < found[other, 0]:
                    poses[other] = pose
                    found[other, 0], found[other, 1] = chi2, sigma
        if not known:
            found[valleys, 0], found[valleys, 1] = chi2, sigma
            valleys += 1
    return poses[:valleys], found[:valleys]


@compiled
def nodes_of(problem: Problem, headings: NDArray[np.bool_], worth_chi2: float) -> Array:
    """Return nodes over a turn that resolve the posterior, by heading, (nodes, 12); 0 if not worth it.

    `headings`, shape (72,), says at which the robot may head at all, the first along x.
    """
    coarse = np.empty((COARSE, 5))
    pose, middle = np.empty(4), np.empty(4)
    information, score, root, step = np.empty((4, 4)), np.empty(4), np.empty((4, 4)), np.empty(4)
    _seen_middle(problem, middle)
    for k in range(COARSE):
        if not headings[k]:
            coarse[k, 4] = np.inf
            continue
        pose[:3] = middle[:3]
        pose[3] = k * (TURN / COARSE)
        _middle(problem, pose, -1.0)
        for _ in range(STEPS):
            chi2 = chi2_at(problem, pose, information, score)
            _solved(information, score, 3, root, step)
            for c in range(3):
                pose[c] += step[c]
                chi2 -= step[c] * score[c]
        coarse[k, :4] = pose
        coarse[k, 4] = chi2  # as the slopes foretell it, which will do to begin from
    poses, valleys = _gone_down(problem, coarse)
    least = valleys[:, 0].min()
    if least > worth_chi2:
        return np.empty((0, COLUMNS))
    deep = np.flatnonzero(valleys[:, 0] < least + WORTH_CHI2)
    grid, count = np.empty((COARSE, COLUMNS)), 0
    for k in range(COARSE):
        if headings[k]:
            pose[:] = coarse[k, :4]
            _placed(problem, pose, STEPS if coarse[k, 4] < least + 2.0 * WORTH_CHI2 else 0, grid[count])
            count += 1
    near = np.empty((len(deep) * (2 * WITHIN + 1), COLUMNS))
    for number in range(len(near)):
        valley = deep[number // (2 * WITHIN + 1)]
        sigma = min(valleys[valley, 1], WIDEST_RAD)
        pose[:] = poses[valley]
        _middle(problem, pose, 1.0)
        off = (number % (2 * WITHIN + 1) - WITHIN) / PER_SIGMA
        pose[3] = (pose[3] + off * sigma) % TURN
        _middle(problem, pose, -1.0)
        _placed(problem, pose, STEPS, near[number])
    nodes = _by_heading(grid[:count], near)
    for _ in range(BISECTIONS):
        count = len(nodes)
        between = np.empty((count, COLUMNS))
        more, lowest = 0, nodes[:, 4].min()
        for k in range(count):
            after = nodes[(k + 1) % count]
            gap = after[0] - nodes[k, 0] + (TURN if k == count - 1 else 0.0)
            worth = min(nodes[k, 4], after[4]) < lowest + WORTH_CHI2
            if worth and abs(after[4] - nodes[k, 4]) > FINEST_CHI2 and gap > FINEST_RAD:
                pose[:3], pose[3] = nodes[k, 1:4], nodes[k, 0]
                _middle(problem, pose, 1.0)
                pose[3] = (nodes[k, 0] + 0.5 * gap) % TURN
                _middle(problem, pose, -1.0)
                _placed(problem, pose, STEPS, between[more])
                more += 1
        if more == 0:
            break
        nodes = _by_heading(nodes, between[:more])
    return nodes


@compiled
def _by_heading(one: Array, other: Array) -> Array:
    """Return the nodes of both by heading, each heading once."""
    every = np.concatenate((one, other))
    order = np.argsort(every[:, 0], kind="mergesort")
    kept, count = np.empty_like(every), 0
    for k in order:
        if count == 0 or every[k, 0] != kept[count - 1, 0]:
            kept[count] = every[k]
            count += 1
    return kept[:count]
