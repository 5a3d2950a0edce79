"""Small seeded images and maps; sides differ from each other everywhere, so that a swap shows."""

import numpy as np
import pytest


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20)
