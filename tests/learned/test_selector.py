"""The selector: its choices and votes against plain twins, what it may change, what it learns from."""

import dataclasses

import numpy as np
import pytest
import torch

from learned.batch import Batch
from learned.checkpoint import ModelCard, load, save
from learned.choices import CHOICES, DESCRIPTION, _front, _votes, describe, find_choices, with_gradients
from learned.hybrid import refine
from learned.inputs import View
from learned.selector import Selector, SelectorConfig, right, selection_loss

HEIGHT, WIDTH = 29, 43
SMALL = SelectorConfig(layers=((8, 1),))


@pytest.fixture
def state() -> torch.Tensor:
    """Two layers, the nearer one a box that moves on its own; every pixel's values differ a little."""
    generator = torch.Generator().manual_seed(0)
    state = torch.zeros(2, 5, HEIGHT, WIDTH)
    state[:, 0], state[:, 1], state[:, 3] = 4, 4, 1
    state[:, 0, 8:20, 12:30], state[:, 2, 8:20, 12:30], state[:, 3, 8:20, 12:30] = 12, 1, -3
    return state + 0.1 * torch.rand(state.shape, generator=generator)


@pytest.fixture
def batch(state: torch.Tensor) -> Batch:
    generator = torch.Generator().manual_seed(1)
    images = torch.rand((2, 4, 3, HEIGHT, WIDTH), generator=generator)
    return Batch(images, start=state, evidence=torch.rand((2, 2, HEIGHT, WIDTH), generator=generator))


def test_choices_are_whole_states_of_the_farthest_and_nearest_pixels(state):
    kept = state.clone()
    choices = find_choices(state)
    torch.testing.assert_close(state, kept, rtol=0, atol=0)
    assert choices.states.shape == (2, CHOICES, 5, HEIGHT, WIDTH)
    torch.testing.assert_close(choices.states[:, 0], state, rtol=0, atol=0)
    flat = state.flatten(2)
    for b, y, x in [(0, 0, 0), (1, 28, 42), (0, 7, 11), (1, 14, 20), (0, 20, 33)]:
        rows, columns = slice(max(y - 4, 0), y + 5), slice(max(x - 4, 0), x + 5)
        around = state[b, 0, rows, columns]
        assert choices.states[b, 1, 0, y, x] == around.min()
        assert choices.states[b, 2, 0, y, x] == around.max()
        for k in range(1, CHOICES):
            there = flat[b, :, choices.sources[b, k - 1, y, x]]
            expected = torch.stack([there[0], state[b, 1, y, x], *there[2:]])
            torch.testing.assert_close(choices.states[b, k, :, y, x], expected, rtol=0, atol=0)
        columns_differ, rows_differ = around.diff(dim=1).abs(), around.diff(dim=0).abs()
        assert choices.step[b, y, x] == max(columns_differ.max(), rows_differ.max())
    assert (choices.jump >= 0).all()


@pytest.mark.parametrize("spread", [0.0, 60.0])
@pytest.mark.parametrize("threads", [1, 2])
def test_kernels_say_what_torch_says(batch, spread, threads):
    """Also of states that lead far outside of the images, of layers that are exactly even, and of any number of threads."""
    state = torch.where(batch.start > 8, 12.0, 4.0) if spread == 0 else batch.start.clone()
    state += spread * (torch.rand(state.shape, generator=torch.Generator().manual_seed(3)) - 0.5)
    state[:, :2].clamp_(min=0)
    kept = state.clone(), batch.images.clone()
    plain = find_choices(state)
    seen = with_gradients(batch.images)
    expected = describe(plain, seen, batch.evidence)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with torch.inference_mode():
            found = find_choices(state)
            described = describe(found, seen, batch.evidence)
            with torch.autocast("cpu", torch.bfloat16):
                halved = describe(found, seen, batch.evidence)
            with torch.autocast("cpu", torch.float16):  # which kernels do not know
                whole = describe(found, seen, batch.evidence)
    finally:
        torch.set_num_threads(before)
    torch.testing.assert_close(found.sources, plain.sources, rtol=0, atol=0)
    torch.testing.assert_close(found.states, plain.states, rtol=0, atol=0)
    torch.testing.assert_close(described, expected, rtol=0, atol=2e-4)
    torch.testing.assert_close(halved, described.bfloat16(), rtol=0, atol=0)
    torch.testing.assert_close(whole, described, rtol=0, atol=0)
    torch.testing.assert_close((state, batch.images), kept, rtol=0, atol=0)


def test_where_nothing_is_a_number_kernels_stay_inside_the_image(batch):
    with torch.inference_mode():
        choices = find_choices(torch.full_like(batch.start, torch.nan))
        own = torch.arange(HEIGHT * WIDTH).view(HEIGHT, WIDTH)
        torch.testing.assert_close(choices.sources, own.expand_as(choices.sources))
        assert describe(choices, with_gradients(batch.images), batch.evidence).shape == (2, DESCRIPTION, HEIGHT, WIDTH)


def test_a_choice_that_the_images_confirm_looks_alike_everywhere():
    """left1 shifted by (D, F, D + C): the true state has no differences, a wrong one has."""
    noise = torch.rand((1, 3, HEIGHT, WIDTH + 60), generator=torch.Generator().manual_seed(2))
    wide = torch.nn.functional.avg_pool2d(noise, 3, 1, 1)
    d1, u, change = 6, 3, 2

    def view(shift: int) -> torch.Tensor:  # view(x - shift) shows what left1 shows at x
        return wide[..., 30 + shift : 30 + shift + WIDTH]

    images = torch.stack([view(0), view(d1), view(-u), view(-u + d1 + change)], 1)
    state = torch.zeros(1, 5, HEIGHT, WIDTH)
    state[:, 0], state[:, 2], state[:, 3] = d1, change, u
    evidence = torch.ones(1, 2, HEIGHT, WIDTH)
    seen = describe(find_choices(state), with_gradients(images), evidence)
    assert seen.shape == (1, DESCRIPTION, HEIGHT, WIDTH)
    inner = seen[..., 2:-2, 12:-12]
    assert inner[:, :6].abs().max() < 1e-4  # the state's own differences: right1, left2, right2
    assert inner[:, 6:8].abs().max() < 1e-4  # nothing hides it, and it leads inside
    for channel, shift in ((0, 2), (3, 1), (2, 1)):
        wrong = state.clone()
        wrong[:, channel] += shift
        differs = describe(find_choices(wrong), with_gradients(images), evidence)[..., 2:-2, 12:-12]
        assert differs[:, :6].amax() > 0.2


def test_the_nearest_thing_hides_what_lands_behind_it():
    disparity = torch.zeros(1, 1, 12)
    disparity[0, 0] = torch.tensor([5.0, 1, 1, 1, 6, 1, 1, 1, 1, 1, 1, 3])
    front = _front(disparity)[0, 0]
    # 5 leaves the image; x = 4 with 6 too; x = 11 lands on 8, where x = 9 lands too
    assert front.tolist() == [1, 1, 1, 0, 1, 1, 1, 1, 3, 1, 0, 0]


def test_votes_equal_their_plain_twin(batch):
    image, disparity, confidence = batch.images[:1, 0], batch.start[:1, :1], batch.evidence[:1, :1]
    image = 0.5 + 0.1 * image
    middle = torch.full_like(disparity, 7.0)
    found = _votes(image, disparity, confidence, middle)
    for y, x in [(0, 0), (28, 42), (14, 11), (7, 30)]:
        totals, fronts = np.full(2, 1e-6), np.zeros(2)
        for dy in range(-9, 10, 3):
            for dx in range(-9, 10, 3):
                if np.hypot(dy, dx) > 9.3:
                    continue
                at = min(max(y + dy, 0), HEIGHT - 1), min(max(x + dx, 0), WIDTH - 1)
                unlike = float((image[0, :, at[0], at[1]] - image[0, :, y, x]).abs().mean())
                vote = max(1 - unlike / 0.1, 0) ** 2 * np.exp(-np.hypot(dy, dx) / 6)
                weights = vote * np.array([1, float(confidence[0, 0, at[0], at[1]]) ** 2])
                totals += weights
                fronts += weights * bool(disparity[0, 0, at[0], at[1]] > 7)
        np.testing.assert_allclose(found[0, :, y, x].numpy(), fronts / totals, rtol=1e-4)


def test_untrained_it_changes_nothing_and_needs_evidence(batch):
    states = refine(Selector(SMALL), batch).states
    assert len(states) == 1 + SMALL.steps
    torch.testing.assert_close(states[-1], batch.start, rtol=0, atol=0)
    with pytest.raises(ValueError, match="confidence"):
        Selector(SMALL)(View(batch.start), dataclasses.replace(batch, evidence=None))


def test_what_it_is_sure_of_is_taken_where_there_is_a_jump(batch):
    selector = Selector(SMALL)
    with torch.no_grad():
        selector.logits.bias.copy_(torch.tensor([0.0, 0, 4]))
    changed = batch.start + selector(View(batch.start), batch).change
    choices = find_choices(batch.start)
    jumps = (choices.step > 1)[:, None].expand_as(changed)
    torch.testing.assert_close(changed[jumps], choices.states[:, 2][jumps])
    torch.testing.assert_close(changed[~jumps], batch.start[~jumps], rtol=0, atol=0)
    unsure = Selector(dataclasses.replace(SMALL, sure=0.98))
    unsure.load_state_dict(selector.state_dict())
    assert unsure(View(batch.start), batch).change.abs().max() == 0


@pytest.mark.parametrize("slope", [(0.9, 0.0), (0.0, 0.9), (0.6, -0.6)])
def test_a_slope_leaves_no_choice(batch, slope):
    state = batch.start.clone()
    state[:, 0] = 40 + slope[0] * torch.arange(HEIGHT)[:, None] + slope[1] * torch.arange(WIDTH)
    selector = Selector(SMALL)
    with torch.no_grad():
        selector.logits.bias.copy_(torch.tensor([0.0, 4, 0]))
    assert selector(View(state), batch).change.abs().max() == 0
    truth = state + torch.tensor([6.0, 0, 0, 0, 0])[:, None, None]
    logits, choices = selector.weigh(state, batch)
    whole, _ = right(choices.states, truth)
    assert whole.any()
    assert not whole[:, 0].any()
    assert selection_loss(logits, choices, truth, 1.0) == 0
    state[:, 0, 20:] += 0.3 + 1  # a step, and more than one together with the slope
    changed = selector(View(state), batch).change[:, 0] != 0
    assert changed[:, 16:24, 1:-1].all()  # at the ends the farthest thing may be the pixel itself
    assert not changed[:, :16].any()
    assert not changed[:, 24:].any()


def test_right_by_kittis_limits_and_unknown_is_no_error():
    truth = torch.full((1, 5, 1, 4), torch.nan)
    truth[0, 0] = torch.tensor([[10.0, 100, 10, 10]])
    truth[0, 3:, 0, 2:] = torch.tensor([[2.0, 2], [0, 0]])
    states = torch.zeros(1, 2, 5, 1, 4)
    states[:, :, 0] = torch.tensor([[13.5, 104.0, 10, 10], [12.5, 106.0, 10, 10]])[:, None]
    states[0, :, 3, 0, 2:] = torch.tensor([[2.0, 6], [4, 2]])
    whole, disparity = right(states, truth)
    assert disparity[0].tolist() == [[[False, True, True, True]], [[True, False, True, True]]]
    assert whole[0].tolist() == [[[False, True, True, False]], [[True, False, True, True]]]


def test_loss_is_the_probability_of_what_is_right(state):
    choices = find_choices(state)
    truth = state.clone()
    truth[:, :, 9, 11] = choices.states[:, 2, :, 9, 11]  # beside the box: it reaches farther
    truth[:, 0, 20:] = torch.nan
    logits = torch.zeros(2, CHOICES, HEIGHT, WIDTH, requires_grad=True)
    loss = selection_loss(logits, choices, truth, 1.0)
    whole, _ = right(choices.states, truth)
    counts = whole.any(1) & ~whole.all(1) & (choices.step > 1) & torch.isfinite(truth[:, 0])
    expected = -(whole.sum(1)[counts] / CHOICES).log().mean()
    torch.testing.assert_close(loss, expected)
    loss.backward()
    assert torch.isfinite(logits.grad).all()
    assert logits.grad[0, 2, 9, 11] < 0 < logits.grad[0, 0, 9, 11]
    assert logits.grad[:, :, 20:].abs().max() == 0
    low, sky = state.clone(), truth.clone()
    low[:, 0] -= 3  # so that the farthest choices are right about the sky
    sky[:, 0], sky[:, 2:] = 0, torch.nan
    assert right(find_choices(low).states, sky)[0].any()
    assert selection_loss(logits, find_choices(low), sky, 1.0) == 0


def test_it_learns_to_mend_an_outline(batch):
    truth = batch.start.clone()
    state = truth.clone()
    state[:, :, 8:20, 28:30] = state[:, :, 8:20, 31:33]  # the box lost its right end
    images = batch.images.clone()
    images[:, :, :, 8:20, 12:30] *= 0.3  # dark, as the end that is lost
    spoilt = dataclasses.replace(batch, images=images, start=state)
    torch.manual_seed(0)
    selector = Selector(SelectorConfig(layers=((16, 1), (16, 1)), steps=1))
    optimizer = torch.optim.Adam(selector.parameters(), 1e-2)
    for _ in range(150):
        loss = selection_loss(*selector.weigh(state, spoilt), truth, 1.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        mended = refine(selector, spoilt).states[-1]

    def wrong(found: torch.Tensor) -> int:
        return int(((found[:, 0] - truth[:, 0]).abs() > 3).sum())

    assert wrong(mended) < 0.3 * wrong(state)


def test_weights_keep_their_configuration(tmp_path):
    selector = Selector(dataclasses.replace(SMALL, sure=0.7, steps=1))
    save(selector, tmp_path / "s.safetensors", ModelCard("a test"))
    again, _ = load(tmp_path / "s.safetensors")
    assert isinstance(again, Selector)
    assert again.config == selector.config


@pytest.mark.parametrize("wrong", [{"layers": ()}, {"steps": -1}, {"sure": 1.5}])
def test_nonsense_is_refused(wrong):
    with pytest.raises(ValueError, match="must"):
        SelectorConfig(**wrong)
