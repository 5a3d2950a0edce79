"""The refiner, its propagation and the loop over steps."""

import dataclasses

import pytest
import torch

from learned.batch import Batch
from learned.hybrid import Hybrid, refine
from learned.oracle import Oracle
from learned.propagation import Propagation, reliability_loss
from learned.refiner import COMPACT, Refiner, RefinerConfig

SMALL = dataclasses.replace(COMPACT, layers=((8, 1), (8, 2)), propagation=(1, 3), steps=3)
HEIGHT, WIDTH = 37, 51


@pytest.fixture
def batch() -> Batch:
    generator = torch.Generator().manual_seed(3)
    images = torch.rand(2, 4, 3, HEIGHT, WIDTH, generator=generator)
    start = 3 * torch.randn(2, 5, HEIGHT, WIDTH, generator=generator)
    return Batch(images, None, start, torch.randn(2, 2, HEIGHT, WIDTH, generator=generator), names=("a", "b"))


def shaken(refiner: Refiner) -> Refiner:
    """Weights away from their neutral start."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in refiner.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    return refiner


def test_published_sizes():
    refiner = Refiner()
    shapes = [tuple(layer.weight.shape) for layer in refiner.modules() if isinstance(layer, torch.nn.Conv2d)]
    assert shapes == [(512, 11, 3, 3), (512, 512, 3, 3), (5, 512, 3, 3)]


@pytest.mark.parametrize("config", [RefinerConfig(layers=((8, 1), (8, 1)), steps=2), SMALL])
def test_untrained_changes_nothing(batch: Batch, config: RefinerConfig):
    states = refine(Refiner(config), batch).states
    assert len(states) == config.steps + 1
    for state in states:
        assert torch.equal(state, batch.start)


@pytest.mark.parametrize("inputs", [("state",), ("state", "loss"), ("state", "gradient"), ("loss", "gradient", "image")])
def test_only_the_chosen_inputs_matter(batch: Batch, inputs: tuple[str, ...]):
    refiner = shaken(Refiner(RefinerConfig(inputs=inputs, layers=((8, 1),))))
    generator = torch.Generator().manual_seed(1)
    loss, gradient = torch.rand(2, HEIGHT, WIDTH, generator=generator), torch.randn(batch.start.shape, generator=generator)
    given = {"state": batch.start, "loss": loss, "gradient": gradient, "images": batch.images[:, (0, 2)].flatten(1, 2)}
    plain = refiner(**given).change
    for name in given:
        changed = refiner(**(given | {name: given[name] + 0.5})).change
        assert torch.equal(plain, changed) == ({"images": "image"}.get(name, name) not in inputs)


def test_energy_is_not_evaluated_without_need(batch: Batch):
    class Forbidden:
        def features(self, state: torch.Tensor) -> None:
            raise AssertionError("nobody needs the energy")

    config = RefinerConfig(inputs=("state",), layers=((8, 1),), steps=2)
    assert len(refine(Refiner(config), batch, Forbidden()).states) == 3


def test_blocks_keep_every_pixel(batch: Batch):
    """A unit change in one pixel reaches the output within the field of view and nowhere else, also at odd sizes."""
    refiner = shaken(Refiner(RefinerConfig(inputs=("state",), layers=((8, 1),), divisor=2)))
    touched = batch.start.clone()
    touched[0, 0, HEIGHT - 1, WIDTH - 1] += 1
    difference = (refiner(touched).change - refiner(batch.start).change).abs().sum(1)
    assert difference[0, HEIGHT - 1, WIDTH - 1] > 0
    assert difference[0, : HEIGHT - 7].max() == 0
    assert difference[1].max() == 0


def test_propagation_takes_over_the_reliable_neighbour():
    """A wrong pixel amid good ones gets their value when the gate is open and its surroundings are trusted."""
    propagation = Propagation(4, 1, (1,))
    torch.nn.init.constant_(propagation.gates.bias, 20.0)  # tanh = 1
    state = torch.full((1, 5, 9, 9), 7.0)
    state[0, :, 4, 4] = 90.0
    change, reliability = propagation(torch.zeros(1, 4, 9, 9), state, torch.full((1, 3, 9, 9), 0.5))
    moved = state + change
    assert reliability.shape == (1, 2, 9, 9)
    assert torch.allclose(moved[0, (0, 2, 3, 4), 4, 4], torch.tensor(7.0))
    assert moved[0, 1, 4, 4] == 90.0  # left2's grid is not touched
    assert torch.allclose(moved[0, 0, 0, 0], torch.tensor(7.0))


def test_propagation_stops_at_edges():
    propagation = Propagation(4, 1, (2,))
    torch.nn.init.constant_(propagation.gates.bias, 20.0)
    torch.nn.init.constant_(propagation.edge_sharpness, 200.0)
    image, state = torch.zeros(1, 3, 12, 12), torch.zeros(1, 5, 12, 12)
    image[..., 6:], state[..., 6:] = 1.0, 30.0
    change, _ = propagation(torch.zeros(1, 4, 12, 12), state, image)
    assert change.abs().max() < 1e-3
    change, _ = propagation(torch.zeros(1, 4, 12, 12), state, torch.zeros_like(image))
    assert change[:, 0].abs().max() > 5


def test_reliability_loss_ignores_unknown_truth():
    generator = torch.Generator().manual_seed(0)
    truth, logits = torch.randn(1, 5, 6, 6, generator=generator), torch.full((1, 2, 6, 6), 30.0)
    truth[0, :, :2] = torch.nan
    state = torch.where(truth.isnan(), 100.0, truth)
    assert reliability_loss(logits, state, truth) < 1e-6
    assert reliability_loss(-logits, state, truth) > 20
    assert reliability_loss(logits, state, torch.full_like(truth, torch.nan)) == 0


def test_detached_steps_learn_from_their_own_loss_alone(batch: Batch):
    for detached in (True, False):
        start = batch.start.clone().requires_grad_()
        refiner = shaken(Refiner(dataclasses.replace(SMALL, detached=detached, steps=1)))
        states = refine(refiner, dataclasses.replace(batch, start=start)).states
        assert states[0] is start
        (gradient,) = torch.autograd.grad(states[-1].sum(), start, allow_unused=True)
        assert (gradient is None) == detached


def test_hybrid_is_networks_then_refiner(batch: Batch):
    class Networks(torch.nn.Module):
        def forward(self, left1, right1, left2, right2):
            return left1.mean(1, keepdim=True).expand(-1, 5, -1, -1), left2[:, :2]

    seen = []
    hybrid = Hybrid(Networks(), shaken(Refiner(SMALL)))
    states = hybrid(batch, watch=lambda t, state, loss, gradient: seen.append((t, loss.shape, gradient.shape))).states
    assert torch.equal(states[0], batch.images[:, 0].mean(1, keepdim=True).expand(-1, 5, -1, -1))
    assert seen == [(t, (2, HEIGHT, WIDTH), (2, 5, HEIGHT, WIDTH)) for t in range(4)]
    by_hand = refine(hybrid.refiner, hybrid.start(batch), Oracle(*batch.frames, batch.images[:, 2, :2])).states
    assert torch.equal(states[-1], by_hand[-1])
    assert not torch.equal(states[-1], states[0])


@pytest.mark.parametrize("wrong", [{"inputs": ()}, {"inputs": ("state", "colour")}, {"inputs": ("state", "state")},
                                   {"evidence": 2}, {"divisor": 0}, {"layers": ()}, {"propagation": (0,)}])  # fmt: skip
def test_impossible_configurations_are_refused(wrong: dict):
    with pytest.raises(ValueError, match="must"):
        RefinerConfig(**wrong)


def test_missing_input_is_named(batch: Batch):
    with pytest.raises(ValueError, match="'loss'"):
        Refiner(RefinerConfig(layers=((8, 1),)))(batch.start)
