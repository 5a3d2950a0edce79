"""Features are matched as by brute force."""

import cv2
import numpy as np

from variational.landmarks import LandmarksConfig, find_landmarks, match_words


def test_words_match_as_by_brute_force() -> None:
    grey = cv2.GaussianBlur(np.random.default_rng(4).random((200, 240), dtype=np.float32), (0, 0), 2)
    grey = (grey - grey.min()) / (grey.max() - grey.min())
    words1, words2 = (find_landmarks(image, LandmarksConfig()).words for image in (grey, np.roll(grey, 7, axis=1)))
    assert len(words1) > 50
    assert (words1 == np.rint(words1)).all()  # what makes the product exact
    places, partners = match_words(words1, words2, 0.85)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(words1, words2, k=2)
    expected = [(m.queryIdx, m.trainIdx) for m, second in pairs if m.distance < 0.85 * second.distance]
    assert 10 < len(expected) < len(words1)
    assert list(zip(places, partners, strict=True)) == expected


def test_none_are_sought_when_switched_off() -> None:
    found = find_landmarks(np.random.default_rng(0).random((60, 80), dtype=np.float32), LandmarksConfig(features=0))
    assert len(found.places) == len(found.words) == 0
