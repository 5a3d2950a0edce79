"""Which objects are near a pixel, where their motions need an excuse and where not."""

import numpy as np
import pytest

from tests.variational.scenes import two_layers
from variational import proposals
from variational.fusion import FusionConfig
from variational.proposals import MEASURED, nearby, with_priors
from variational.rigid import RigidMotion
from variational.solver import Solution, solve

SHAPE = (60, 100)


def motion(rows: slice, columns: slice) -> RigidMotion:
    support = np.zeros(SHAPE, bool)
    support[rows, columns] = True
    return RigidMotion(np.eye(4), np.eye(4), support)


def test_objects_are_near_within_their_reach_and_found_on_their_own_pixels() -> None:
    camera = motion(slice(None), slice(None))
    small, large = motion(slice(20, 24), slice(10, 14)), motion(slice(10, 40), slice(70, 90))
    labels, found = nearby([camera, small, large], 2)
    assert labels.shape == found.shape == (2, *SHAPE)
    assert (labels[0][small.support] == 1).all()
    assert (labels[0][large.support] == 2).all()
    np.testing.assert_array_equal(found[0], small.support | large.support)
    assert not found[1].any()
    assert labels[0, 22, 16] == 1  # beside the small one
    assert labels[0, 22, 36] == MEASURED  # far from both
    assert labels[0, 45, 68] == 2


def test_an_objects_motion_is_free_where_it_was_found() -> None:
    costs = np.zeros((4, 1, 2), np.float32)
    found = np.array([[[True, False]], [[False, False]]])
    config = FusionConfig(measured_prior=0.25, object_prior=0.125)
    biased = with_priors(costs, found, config)
    np.testing.assert_array_equal(biased[:, 0], [[0.25, 0.25], [0, 0], [0, 0.125], [0.125, 0.125]])
    assert not costs.any()


def test_a_motion_that_the_images_do_not_show_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the flow had slipped along the background's upper left."""
    frames, find = two_layers(96, 144).frames, proposals.find_motions

    def solved(slip: bool) -> Solution:
        def found(*args: object) -> list[RigidMotion]:
            motions = find(*args)
            support = np.zeros(frames.shape, bool)
            support[5:25, 5:60] = True
            homography = motions[0].homography.copy()
            homography[0, 3] += 6
            return [*motions, RigidMotion(np.eye(4), homography, support)] if slip else motions

        monkeypatch.setattr(proposals, "find_motions", found)
        return solve(frames)

    np.testing.assert_array_equal(solved(True).state, solved(False).state)
