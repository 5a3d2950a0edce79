"""Rendered stereo video with exact truth as data sets: nothing is read from disk, so `root` is not looked at.

``synthetic-things`` and ``synthetic-street`` render any number of samples on the fly; the options of
`cgsf.synthetic.RenderConfig` are accepted. ``synthetic-v1`` is frozen, so that results stay comparable: 20 samples of
each family, seeds 1,000,000 to 1,000,019, `street` at 376 x 1242 and `things` at 384 x 640 pixels (height x width), no
photographs, default options.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cgsf.datasets.sample import Sample
from cgsf.errors import InputError
from cgsf.synthetic import make_sample, make_video


class Synthetic:
    """Samples of one family of scenes.

    Parameters
    ----------
    root : Path
        Not used.
    family : str
    count : int
        Number of scenes.
    seed : int
        Seed of the first scene; the others follow.
    height, width : int
        Image size in pixels.
    frames : int
        Length of each scene's video; it gives one sample less, of two frames that follow each other.
    sky : bool
        False: the truth of the sky (disparity 0) counts as unknown, as it is in real frames.
    **options
        Fields of `RenderConfig`.
    """

    def __init__(
        self,
        root: Path,
        family: str,
        count: int = 20,
        seed: int = 0,
        height: int = 376,
        width: int = 1242,
        frames: int = 2,
        sky: bool = True,
        **options: Any,
    ) -> None:
        whole = {"count": count, "seed": seed, "height": height, "width": width, "frames": frames}
        for name, value in whole.items():
            if not isinstance(value, int):
                raise InputError(f"{name} must be a whole number, got {value!r}")
        if not isinstance(sky, bool):
            raise InputError(f"sky must be true or false, got {sky!r}")
        if count < 1 or frames < 2:
            raise InputError(f"count must be at least 1 and frames at least 2, got {count} and {frames}")
        self.family, self.seeds, self.size, self.options = family, range(seed, seed + count), (height, width), options
        self.frames, self.sky = frames, sky
        scenes = [f"{family}-{number:06d}" for number in self.seeds]
        self.names = scenes if frames == 2 else [f"{name}/{frame:03d}" for name in scenes for frame in range(frames - 1)]
        self._video: tuple[int, list[Sample]] | None = None

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Sample:
        sample = self._render(index)
        return sample if self.sky else _without_sky(sample)

    def _render(self, index: int) -> Sample:
        scene, frame = divmod(range(len(self))[index], self.frames - 1)
        if self.frames == 2:
            return make_sample(self.family, self.seeds[scene], *self.size, **self.options)
        if self._video is None or self._video[0] != scene:  # a video is rendered as a whole
            self._video = scene, make_video(self.family, self.seeds[scene], *self.size, self.frames, **self.options)
        return self._video[1][frame]


def _without_sky(sample: Sample) -> Sample:
    """Its truth unknown where the disparity is 0."""
    truth = sample.truth
    assert truth is not None
    assert truth.disparity1 is not None
    sky = truth.disparity1 <= 0
    known = {name: getattr(truth, name).copy() for name in ("disparity1", "disparity2", "flow")}
    for each in known.values():
        each[sky] = np.nan
    return replace(sample, truth=replace(truth, **known))


class Street(Synthetic):
    """``synthetic-street``."""

    def __init__(self, root: Path, **options: Any) -> None:
        super().__init__(root, "street", **options)


class Things(Synthetic):
    """``synthetic-things``."""

    def __init__(self, root: Path, **options: Any) -> None:
        super().__init__(root, "things", **({"height": 384, "width": 640} | options))


class SyntheticV1:
    """``synthetic-v1``, the frozen test split.

    Parameters
    ----------
    root : Path
        Not used.
    family : {"street", "things"}, optional
        Only one half of it.
    """

    FIRST_SEED, COUNT = 1_000_000, 20

    def __init__(self, root: Path, family: str | None = None) -> None:
        halves = {"street": Street, "things": Things}
        if family is not None and family not in halves:
            raise InputError(f"unknown family {family!r}; synthetic-v1 has street and things")
        chosen = [family] if family else ["street", "things"]
        self._halves = [halves[name](root, count=self.COUNT, seed=self.FIRST_SEED) for name in chosen]
        self.names = [name for half in self._halves for name in half.names]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Sample:
        place = range(len(self))[index]
        return self._halves[place // self.COUNT][place % self.COUNT]
