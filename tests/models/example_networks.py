"""An encoder of driving, and how many items it reads."""

import torch

from mirror_ppl.domains import get_domain
from mirror_ppl.models.networks import Encoder
from mirror_ppl.models.sizes import Sizes

DRIVING = get_domain("driving")
ITEMS = {"visual": 4, "verbal": 4}


def encoder(dtype=torch.float64):
    return Encoder(DRIVING, Sizes()).to(dtype)
