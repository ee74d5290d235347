"""A scene of driving, of which experience is worked out by hand."""

import torch

from mirror_ppl.domains.driving import DrivingState


def two_cars_near():
    """The ego in the left lane; a slow car 3 cells ahead of it, and one 2 cells behind at right."""
    return DrivingState(
        lane=torch.tensor([0]),
        position=torch.tensor([[3, 11, -11, -2]]),
        speed=torch.tensor([[-1, 1, -1, -1]]),
    )


STAY4 = torch.zeros(1, 4, dtype=torch.long)
