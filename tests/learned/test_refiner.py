"""The refiner, what it may take over, and the loop over steps."""

import dataclasses

import pytest
import torch

from learned import alternatives
from learned.alternatives import Alternatives, Grid, Neighbours, camera_motion, gated_change, second_pair
from learned.batch import Batch
from learned.hybrid import Hybrid, refine
from learned.inputs import View, look
from learned.oracle import Oracle
from learned.refiner import COMPACT, Refiner, RefinerConfig

SMALL = dataclasses.replace(COMPACT, layers=((8, 1), (8, 2)), neighbours=(1, 3), steps=3)
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
    view = View(batch.start, loss, gradient)
    plain = refiner(view, batch).change
    for name in ("state", "loss", "gradient"):
        changed = refiner(view._replace(**{name: getattr(view, name) + 0.5}), batch).change
        assert torch.equal(plain, changed) == (name not in inputs)
    changed = refiner(view, dataclasses.replace(batch, images=batch.images + 0.5)).change
    assert torch.equal(plain, changed) == ("image" not in inputs)


def test_energy_is_not_evaluated_without_need(batch: Batch):
    class Forbidden:
        def features(self, state: torch.Tensor) -> None:
            raise AssertionError("nobody needs the energy")

    config = RefinerConfig(inputs=("state",), layers=((8, 1),), steps=2)
    assert len(refine(Refiner(config), batch, Forbidden()).states) == 3


def test_every_pixel_of_a_block_gets_its_change():
    """Odd sizes too; what a block's pixel says stays within the field of view."""
    state = torch.zeros(1, 5, HEIGHT, WIDTH)
    empty = Batch(torch.zeros(1, 4, 3, HEIGHT, WIDTH))
    refiner = shaken(Refiner(RefinerConfig(inputs=("state",), layers=((8, 1),), divisor=2)))
    touched = state.clone()
    touched[0, 0, HEIGHT - 1, WIDTH - 1] += 1
    difference = (refiner(View(touched), empty).change - refiner(View(state), empty).change).abs().sum(1)
    assert difference.shape == (1, HEIGHT, WIDTH)
    assert difference[0, HEIGHT - 1, WIDTH - 1] > 0
    assert difference[0, : HEIGHT - 7].max() == 0


@pytest.mark.parametrize("kernel", [False, True])
def test_grid_picks_the_last_pixel_of_each_block(kernel: bool):
    maps, grid = torch.arange(5 * 7.0).reshape(1, 1, 5, 7), Grid(2)
    with torch.set_grad_enabled(not kernel):
        picked = grid.pick(maps)
    columns, rows = grid.coordinates(picked)
    assert torch.equal(columns, torch.tensor([1.0, 3, 5, 7]))
    assert torch.equal(rows[:, 0], torch.tensor([1.0, 3, 5]))
    assert torch.equal(picked[0, 0, :2, :3], 7 * rows[:2] + columns[:3])
    assert torch.equal(picked[0, 0, 2], torch.tensor([29.0, 31, 33, 34]))  # the border's values repeat
    assert torch.equal(grid.spread(picked, (5, 7))[0, 0, :2, :2], torch.full((2, 2), 8.0))


def test_neighbours_that_are_trusted_outvote_a_wrong_pixel():
    state = torch.full((1, 5, 9, 9), 7.0)
    state[0, :, 4, 4] = 90.0
    neighbours = Neighbours((1,))
    nothing = torch.zeros(1, 8, 9, 9), torch.zeros(1, 8, 9, 9), torch.tensor(0.0)
    assert torch.allclose(neighbours.mixture(state, *nothing, torch.zeros(1, 2, 9, 9))[0, :, 4, 4], torch.tensor(7.0))
    reliability = torch.zeros(1, 2, 9, 9)
    reliability[0, 0, 4, 4] = -50.0  # of its disparity alone
    mixture = neighbours.mixture(state, *nothing, reliability)
    assert torch.allclose(mixture[0, 0], torch.tensor(7.0))
    assert mixture[0, 1:, 4, 5].min() > 15


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_mixture_kernel_does_what_is_written_plainly(dtype: torch.dtype):
    generator = torch.Generator().manual_seed(0)
    state, contrasts = 50 * torch.randn(2, 5, 9, 13, generator=generator), torch.rand(2, 16, 9, 13, generator=generator)
    neighbours, reliability = Neighbours((1, 3)), 9 * torch.randn(2, 2, 9, 13, generator=generator)
    # as a convolution leaves it: channels innermost
    preference = (9 * torch.randn(2, 16, 9, 13, generator=generator)).to(dtype).to(memory_format=torch.channels_last)
    arguments = state, preference, contrasts, torch.tensor(7.0), reliability
    plain = neighbours.mixture(*arguments)
    with torch.no_grad():
        assert torch.allclose(neighbours.mixture(*arguments), plain, rtol=1e-5, atol=1e-4)
        assert not torch.allclose(neighbours.mixture(-state, *arguments[1:]), plain, atol=1)


def test_contrasts_are_those_of_the_neighbours():
    image = torch.zeros(1, 3, 12, 12)
    image[..., 6:] = 1.0
    contrasts = Neighbours((2,)).contrasts(image)
    assert contrasts.shape == (1, 8, 12, 12)
    assert contrasts[0, :, 5, 2].max() == 0
    assert contrasts[0, :, 5, 5].sum() == 3  # the three on the right


def test_camera_motion_of_a_turn_and_a_step():
    """A homography that adds to x and y and scales the disparity, at asymmetric sizes and picked pixels."""
    homography = torch.eye(4, dtype=torch.float64)[None]
    homography[0, 0, 3], homography[0, 1, 3], homography[0, 2, 2] = 3.0, -2.0, 1.25
    change, u, v = camera_motion(torch.full((1, 5, 4, 6), 8.0), Grid(2).coordinates(torch.empty(4, 6)), homography)[0]
    assert torch.allclose(change, torch.tensor(2.0))
    assert torch.allclose(u, torch.tensor(3.0))
    assert torch.allclose(v, torch.tensor(-2.0))
    homography[0, 3, 3] = 2.0  # everything twice as far from the origin's projection
    x, y = Grid(1).coordinates(torch.empty(4, 6))
    _, u, v = camera_motion(torch.full((1, 5, 4, 6), 8.0), (x, y), homography)[0]
    assert torch.allclose(u, ((x + 3) / 2 - x).expand(4, 6))
    assert torch.allclose(v, ((y - 2) / 2 - y).expand(4, 6))


def test_points_behind_the_camera_keep_their_motion():
    """However open a gate is, nothing unbounded comes through it."""
    homography = torch.eye(4, dtype=torch.float64)[None]
    homography[0, 3, 2] = -0.125  # depth falls to nothing at disparity 8
    state = torch.randn(1, 5, 4, 6, generator=torch.Generator().manual_seed(2))
    state[:, 0] = torch.tensor([1.0, 7.9, 8.0, 8.1, 9.0, 100.0])
    motion = camera_motion(state, Grid(1).coordinates(state), homography)
    assert torch.equal(motion[..., 1:], state[:, 2:, :, 1:])
    assert not torch.allclose(motion[..., 0], state[:, 2:, :, 0])


def test_second_pair_is_looked_up_where_the_flow_leads_to():
    y, x = torch.meshgrid(torch.arange(10.0), torch.arange(14.0), indexing="ij")
    d2, backward = (x + 10 * y)[None, None], torch.stack([-x / 7, y / 5])[None]
    state = torch.tensor([4.0, 0, 2, 3, -1])[:, None, None].expand(5, 10, 14)
    grid = Grid(2)
    residual, round_trip = second_pair(grid.pick(state[None]), grid.coordinates(torch.empty(5, 7)), d2, backward)
    assert residual[0, 0, 1, 2] == pytest.approx(5 + 3 + 10 * (3 - 1) - 4 - 2, abs=1e-4)
    assert round_trip[0, 0, 1, 2] == pytest.approx(((3 - 8 / 7) ** 2 + (-1 + 2 / 5) ** 2) ** 0.5, abs=1e-5)


def _alternatives(mixture: list[float], camera: list[float], residual: float) -> Alternatives:
    return Alternatives(*(torch.tensor(values)[None, :, None, None] for values in (mixture, camera, [residual])))


OPEN = 20.0  # its hyperbolic tangent is one


@pytest.mark.parametrize(("gate", "expected"), [(0, [7, 0, 0, 0]), (1, [20, 0, 0, 0]), (2, [0, 1, 2, 3]), (3, [0, 4, 5, 6]),
                                                (4, [0, 20, 0, 0])])  # fmt: skip
def test_each_gate_lets_in_one_alternative(gate: int, expected: list[float]):
    offers = _alternatives([7.0, 1, 2, 3], [4.0, 5, 6], 20.0)
    gates = torch.zeros(1, 5, 1, 1)
    gates[:, gate] = OPEN
    nothing = torch.zeros(1, 5, 1, 1)
    change = gated_change(nothing, offers, nothing, gates, Grid(1))[0, :, 0, 0]
    assert change[1] == 0
    assert torch.equal(change[[0, 2, 3, 4]], torch.tensor(expected, dtype=torch.float32))


def test_both_motions_at_once_do_not_add_up():
    """Neighbours and camera agree on a value: a pixel that trusts both gets it once."""
    offers, nothing = _alternatives([0.0, 5, 5, 5], [5.0, 5, 5], 0.0), torch.zeros(1, 5, 1, 1)
    gates = OPEN * torch.tensor([0.0, 0, 1, 1, 0])[None, :, None, None]
    change = gated_change(nothing, offers, nothing, gates, Grid(1))
    assert torch.equal(change[0, 2:, 0, 0], torch.full((3,), 5.0))


def test_corrections_have_a_bound():
    correction, closed = torch.tensor([[0.01, -0.01, 1e4, -1e4, 0]])[..., None, None], torch.zeros(1, 5, 1, 1)
    change = gated_change(closed, _alternatives([0.0] * 4, [0.0] * 3, 0.0), correction, closed, Grid(1))[0, :, 0, 0]
    torch.testing.assert_close(change, torch.tensor([0.01, -0.01, 4, -4, 0]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(("divisor", "size"), [(1, (5, 7)), (2, (5, 7)), (2, (6, 9)), (3, (8, 10))])
def test_the_gates_kernel_does_what_is_written_plainly(divisor: int, size: tuple[int, int], dtype: torch.dtype):
    generator = torch.Generator().manual_seed(divisor)
    blocks = [-(-side // divisor) for side in size]
    state = 10 * torch.randn(2, 5, *size, generator=generator)
    offers = Alternatives(*(10 * torch.randn(2, n, *blocks, generator=generator) for n in (4, 3, 1)))
    correction, gates = (torch.randn(2, n, *blocks, generator=generator).to(dtype, memory_format=torch.channels_last)
                         for n in (5, 5 * divisor**2))
    plain = gated_change(state, offers, correction, gates, Grid(divisor))
    with torch.no_grad():
        assert torch.allclose(gated_change(state, offers, correction, gates, Grid(divisor)), plain, atol=1e-4)


KINDS = [SMALL, dataclasses.replace(SMALL, inputs=("state",)), dataclasses.replace(SMALL, divisor=1),
         dataclasses.replace(SMALL, inputs=("gradient", "evidence", "deviation", "loss"), evidence=3, divisor=3)]  # fmt: skip


@pytest.mark.parametrize("config", KINDS)
def test_the_inputs_kernel_does_what_is_written_plainly(batch: Batch, config: RefinerConfig):
    generator = torch.Generator().manual_seed(2)
    homography = torch.eye(4, dtype=torch.float64) + 0.01 * torch.randn(2, 4, 4, generator=generator)
    evidence = torch.rand(2, 3, HEIGHT, WIDTH, generator=generator)
    batch = dataclasses.replace(batch, homography=homography, evidence=evidence)
    loss, camera_loss = 30 * torch.rand(2, 2, HEIGHT, WIDTH, generator=generator)
    gradient = 8 * torch.randn(2, 5, HEIGHT, WIDTH, generator=generator)
    view = View(batch.start, loss, gradient, camera_loss)
    plain = look(config, Grid(config.divisor), view, batch)
    with torch.no_grad():
        seen = look(config, Grid(config.divisor), view, batch)
        with torch.autocast("cpu", torch.bfloat16):
            rounded = look(config, Grid(config.divisor), view, batch).inputs
    assert plain.inputs.shape[1] == config.channels
    for one, other in zip(seen, plain, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)
    assert rounded.dtype == torch.bfloat16
    assert rounded.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(rounded.float(), plain.inputs, rtol=0.01, atol=1e-3)


def test_the_contrasts_kernel_does_what_is_written_plainly():
    image = torch.rand(2, 3, 9, 13, generator=torch.Generator().manual_seed(6))
    plain = Neighbours((1, 3)).contrasts(image)
    with torch.no_grad():
        torch.testing.assert_close(Neighbours((1, 3)).contrasts(image), plain)


def test_the_cameras_energy_is_looked_at(batch: Batch):
    """A camera that explains the motion is told apart from one that does not."""
    refiner = shaken(Refiner(SMALL))
    moved = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    moved[:, 0, 3] = 5.0
    still = torch.eye(4, dtype=torch.float64).expand(2, 4, 4)
    states = [refine(refiner, dataclasses.replace(batch, homography=motion)).states[1] for motion in (None, still, moved)]
    assert not torch.allclose(states[1], states[2])
    assert not torch.allclose(states[0], states[1])


def test_reliability_loss_ignores_unknown_truth():
    generator = torch.Generator().manual_seed(0)
    truth, logits = torch.randn(1, 5, 6, 6, generator=generator), torch.full((1, 2, 6, 6), 30.0)
    truth[0, :, :2] = torch.nan
    state = torch.where(truth.isnan(), 100.0, truth)
    assert alternatives.reliability_loss(logits, state, truth) < 1e-6
    assert alternatives.reliability_loss(-logits, state, truth) > 20
    assert alternatives.reliability_loss(logits, state, torch.full_like(truth, torch.nan)) == 0


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
                                   {"evidence": 2}, {"divisor": 0}, {"layers": ()}, {"neighbours": (0,)}])  # fmt: skip
def test_impossible_configurations_are_refused(wrong: dict):
    with pytest.raises(ValueError, match="must"):
        RefinerConfig(**wrong)


def test_missing_input_is_named(batch: Batch):
    with pytest.raises(ValueError, match="'loss'"):
        Refiner(RefinerConfig(layers=((8, 1),)))(View(batch.start), batch)
