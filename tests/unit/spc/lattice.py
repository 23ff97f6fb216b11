"""The two sums of a CUSUM as one Markov chain on a lattice: an independent solver for how the sides combine.

Values are rounded to multiples of a step that divides k, so both sums stay on the lattice and every state that can be
reached is known exactly. The limit lies midway between two points of it. Then the error is of the order of step^2, and
a third of the step, for which the same limit is midway too, tells where both lead (Richardson).
"""

import numpy as np
from scipy import sparse, special
from scipy.sparse import linalg


class Lattice:
    """States and transitions of a two-sided CUSUM.

    Args:
        k: allowance.
        points: of the lattice in (0, h): h = (points + 1/2) k / steps.
        steps: in k.
        start: where both sums start.
    """

    def __init__(self, k: float, points: int, steps: int, start: float = 0.0) -> None:
        self.step = k / steps
        self.limit = points
        first = (round(start / self.step),) * 2
        self.number = {first: 0}
        todo = [first]
        self.moves: list[tuple[int, int, int]] = []
        reach = range(-2 * self.limit - 2 * steps, 2 * self.limit + 2 * steps + 1)
        while todo:
            state = todo.pop()
            for move in reach:
                target = (max(0, state[0] + move - steps), max(0, state[1] - move - steps))
                if max(target) > self.limit:
                    continue
                if target not in self.number:
                    self.number[target] = len(self.number)
                    todo.append(target)
                self.moves.append((self.number[state], self.number[target], move))

    def transitions(self, shift: float) -> sparse.csc_array:
        """K for a shift."""
        source, target, move = np.array(self.moves).T
        share = special.ndtr((move + 0.5) * self.step - shift) - special.ndtr((move - 0.5) * self.step - shift)
        size = len(self.number)
        return sparse.csc_array((share, (source, target)), shape=(size, size))

    def zero_state(self, shift: float) -> float:
        """The run length from the start."""
        return float(self._lengths(shift)[0])

    def steady_state(self, shift: float) -> float:
        """The run length after long without a signal."""
        in_control = self.transitions(0.0)
        solver = linalg.splu((sparse.eye_array(in_control.shape[0]) - in_control).T.tocsc())
        share = np.ones(in_control.shape[0]) / in_control.shape[0]
        for _ in range(30):
            share = solver.solve(share)
            share /= share.sum()
        return float(share @ self._lengths(shift))

    def _lengths(self, shift: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        K = self.transitions(shift)
        return np.asarray(linalg.spsolve((sparse.eye_array(K.shape[0]) - K).tocsc(), np.ones(K.shape[0])))
