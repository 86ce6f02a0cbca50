"""How weights and learning rates change over a run. Iterations are counted from 1 to `iterations`."""

import math


def regularization_weight(iteration: int, iterations: int, hold: int) -> float:
    """The global weight gamma of the regularizers, paper section 3.3: cosine decay from 1 to 0.

    gamma = 1 up to iteration `hold`, then (1 + cos(pi (iteration - hold) / (iterations - hold))) / 2, which is 0 at the
    last iteration. The paper: hold 500 of 30,000.

    Args:
        iteration: 1..iterations.
        iterations: length of the run.
        hold: last iteration at full weight, 0 <= hold. A run no longer than `hold` keeps 1 throughout.
    """
    if iteration <= hold:
        return 1.0
    return 0.5 * (1.0 + math.cos(math.pi * (iteration - hold) / (iterations - hold)))


def exponential_decay(iteration: int, iterations: int, ratio: float) -> float:
    """Factor on a learning rate: falls exponentially from 1 at the first iteration to `ratio` at the last.

    Args:
        iteration: 1..iterations.
        iterations: length of the run.
        ratio: factor at the last iteration, > 0.
    """
    if iterations <= 1:
        return 1.0
    return ratio ** ((iteration - 1) / (iterations - 1))
