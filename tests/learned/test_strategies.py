"""The three online strategies: same energy, weights restored."""

import dataclasses

import pytest
import torch

from learned.batch import Batch
from learned.oracle import Oracle
from learned.refiner import Refiner, RefinerConfig
from learned.strategies import StrategyConfig, adapt_video, apply_strategy, restored


class Networks(torch.nn.Module):
    """Small, but a state with a graph."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.state = torch.nn.Conv2d(6, 5, 3, padding=1)
        self.norm = torch.nn.BatchNorm2d(5)

    def forward(self, left1, right1, left2, right2):
        state = self.norm(self.state(torch.cat([left1, left2], 1))) + 1
        return state, -state[:, 3:]


@pytest.fixture
def networks() -> Networks:
    return Networks().eval()


@pytest.fixture
def batch(networks: Networks) -> Batch:
    images = torch.rand(1, 4, 3, 24, 32, generator=torch.Generator().manual_seed(2))
    images = torch.nn.functional.avg_pool2d(images.flatten(0, 1), 5, 1, 2).unflatten(0, (1, 4))
    with torch.no_grad():
        state, backward = networks(*images.unbind(1))
    return Batch(images, None, state, backward)


def damage(networks: Networks) -> None:
    networks.state.weight.data.zero_()
    raise ZeroDivisionError


def energy(batch: Batch, state: torch.Tensor) -> float:
    return float(Oracle(*batch.frames, batch.backward_flow).energy(state).sum())


@pytest.mark.parametrize(("strategy", "steps"), [("outputs", 20), ("parameters", 20)])
def test_descent_lowers_the_energy(batch: Batch, networks: Networks, strategy: str, steps: int):
    config = StrategyConfig(strategy, steps, outputs_rate=0.02, parameters_rate=1e-3)
    refined = apply_strategy(config, batch, networks=networks)
    assert energy(batch, refined.state) < 0.98 * energy(batch, batch.start)
    assert refined.seconds > 0
    assert torch.equal(refined.states[0], batch.start)


def test_parameters_are_restored(batch: Batch, networks: Networks):
    before = {name: value.clone() for name, value in networks.state_dict().items()}
    apply_strategy(StrategyConfig("parameters", 3, parameters_rate=0.1), batch, networks=networks)
    assert all(torch.equal(before[name], value) for name, value in networks.state_dict().items())
    assert all(parameter.grad is None for parameter in networks.parameters())


def test_parameters_are_restored_after_an_error(networks: Networks):
    before = networks.state.weight.clone()
    with pytest.raises(ZeroDivisionError), restored(networks):
        damage(networks)
    assert torch.equal(networks.state.weight, before)


def test_learned_equals_the_loop(batch: Batch):
    refiner = Refiner(RefinerConfig(layers=((4, 1),), steps=2))
    torch.nn.init.normal_(refiner.correction.weight, std=0.1, generator=torch.Generator().manual_seed(0))
    assert len(apply_strategy(StrategyConfig("learned"), batch, refiner).states) == 3
    assert len(apply_strategy(StrategyConfig("learned", 7), batch, refiner).states) == 8


def test_a_video_adapts_as_it_goes(batch: Batch, networks: Networks):
    before = networks.state.weight.clone()
    config = StrategyConfig("parameters", 5, parameters_rate=1e-3)
    frame = dataclasses.replace(batch, start=None, backward_flow=None)
    states = list(adapt_video(config, [frame, frame, frame], networks))
    energies = [energy(batch, state) for state in states]
    assert energies[2] < energies[1] < energies[0]
    assert torch.equal(networks.state.weight, before)


def test_weights_come_back_when_a_video_is_left(batch: Batch, networks: Networks):
    before = networks.state.weight.clone()
    frames = adapt_video(StrategyConfig("parameters", 2, parameters_rate=0.1), [batch] * 5, networks)
    next(frames)
    frames.close()
    assert torch.equal(networks.state.weight, before)


@pytest.mark.parametrize(("strategy", "missing"), [("learned", "a refiner"), ("parameters", "networks")])
def test_what_is_missing_is_named(batch: Batch, strategy: str, missing: str):
    with pytest.raises(ValueError, match=missing):
        apply_strategy(StrategyConfig(strategy), batch)
