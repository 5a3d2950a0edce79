"""What a method says of real frames, where it is surest, in place of a truth that nobody has: networks learn from it how
real images look.

Related: Tonioni et al., Unsupervised Adaptation for Deep Stereo, ICCV 2017 (a classical matcher teaches, its confidence
selects).
"""

from __future__ import annotations

import numpy as np

from cgsf.datasets import Dataset, Sample, Truth
from cgsf.errors import InputError
from cgsf.pipelines import load_config, solve
from variational.initialise import sample as sample_at


class PseudoTruth:
    """A data set whose truth is what a method says; whatever else its samples know as truth is not looked at.

    Parameters
    ----------
    source : Dataset
    method : str
        One that tells how sure it is, as ``variational``.
    keep : float
        Share of an image's pixels, the surest ones, that are taken for true; the others are unknown.
    reverse : bool
        Add every sample with its two times exchanged.
    """

    def __init__(self, source: Dataset, method: str = "variational", keep: float = 0.7, reverse: bool = False) -> None:
        self.source, self.method, self.keep, self.reverse = source, method, keep, reverse
        self.names = [name for one in source.names for name in ([one, f"{one}-reversed"] if reverse else [one])]
        self._config = load_config(method)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Sample:
        backwards = self.reverse and index % 2 == 1
        sample = self.source[index // 2 if self.reverse else index]
        left1, right1, left2, right2 = sample.images
        images = (left2, right2, left1, right1) if backwards else sample.images
        result = solve(images, self.method, self._config, sample.calibration)
        if result.confidence is None or result.backward_flow is None:
            raise InputError(f"the method {self.method!r} does not tell how sure it is; take variational")
        there = sample_at(np.ascontiguousarray(result.confidence), np.ascontiguousarray(result.backward_flow))
        sure, sure_at_2 = self._surest(result.confidence), self._surest(there)
        truth = Truth(
            np.where(sure, result.disparity1, np.nan),
            np.where(sure, result.disparity2_on_left1, np.nan),
            np.where(sure[..., None], result.flow, np.nan),
            disparity_left2=np.where(sure_at_2, result.disparity2, np.nan),
        )
        return Sample(self.names[index], *images, sample.calibration, truth)

    def _surest(self, confidence: np.ndarray) -> np.ndarray:
        return confidence >= np.quantile(confidence, 1 - self.keep)
