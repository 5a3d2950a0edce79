"""Batches for training: samples of caches with their starts, shuffled, cropped and augmented."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from cgsf.errors import InputError
from cgsf.recipe import Recipe
from cgsf.sample_cache import SampleCache
from cgsf.start_cache import StartCache
from learned.augment import augment
from learned.batch import Batch


@dataclass(frozen=True)
class Source:
    """Samples, and what a refiner needs of each of them if one is trained."""

    cache: SampleCache
    starts: StartCache | None = None

    @staticmethod
    def open(cache: str, starts: str = "") -> Source:
        """From folders, without starts if that is an empty word. `InputError` if they do not belong together."""
        samples = SampleCache(cache)
        return Source(samples, _starts(starts, samples) if starts else None)

    def __len__(self) -> int:
        return min(len(part) for part in (self.cache, self.starts) if part is not None)

    def __getitem__(self, index: int) -> Batch:
        """One sample as a batch; its images are bytes."""
        images, truth = (torch.from_numpy(np.array(array)[None]) for array in self.cache[index])
        plain = Batch(images.permute(0, 1, 4, 2, 3), truth, names=(self.cache.names[index],))
        if self.starts is None:
            return plain
        known = {name: torch.from_numpy(np.array(array)[None]) for name, array in self.starts[index].items()}
        return replace(
            plain, start=known["start"], backward_flow=known["backward"], evidence=known["evidence"],
            homography=known["homography"],
        )  # fmt: skip


class Batches:
    """``batch_at`` over a source: every pass shuffles anew, every draw depends on the index alone.

    Parameters
    ----------
    recipe : Recipe
    source : Source
        Its first samples are held out.
    further : sequence of Source
        Drawn from now and then, as the recipe's ``further_share`` says.
    """

    def __init__(self, recipe: Recipe, source: Source, further: Sequence[Source] = ()) -> None:
        self.recipe, self.source = recipe, source
        self.further = [(more, index) for more in further for index in range(len(more))]
        self.count = len(source) - recipe.held_out

    def __call__(self, index: int) -> Batch:
        recipe, seed = self.recipe, self.recipe.training.seed
        chosen = []
        for position in range(index * recipe.batch, (index + 1) * recipe.batch):
            draw = np.random.default_rng([seed, position, len(self.further)])
            if self.further and draw.random() < recipe.further_share:
                more, which = self.further[draw.integers(len(self.further))]
                chosen.append(more[which])
            else:
                order = np.random.default_rng([seed, position // self.count]).permutation(self.count)
                chosen.append(self.source[recipe.held_out + int(order[position % self.count])])
        generator = torch.Generator().manual_seed(seed * 1_000_003 + index)
        return Batch.cat([augment(sample, recipe.augment, generator) for sample in chosen])

    def held_out(self) -> Iterator[Batch]:
        """The samples that are never trained with, whole and unchanged."""
        for index in range(self.recipe.held_out):
            sample = self.source[index]
            yield replace(sample, images=sample.images.float() / 255)


def further_sources(recipe: Recipe) -> list[Source]:
    """A recipe's further samples; `InputError` if they lack what its own ones have."""
    if not recipe.further:
        return []
    if recipe.cached_networks:
        raise InputError("further samples are for single networks and refiners, not for joint training from starts")
    starts = recipe.further_starts if recipe.stage in ("refiner", "selector") else ("",) * len(recipe.further)
    if len(starts) != len(recipe.further):
        raise InputError("each folder of further samples needs its further_starts")
    return [Source.open(*folders) for folders in zip(recipe.further, starts, strict=True)]


def _starts(folder: str, cache: SampleCache) -> StartCache:
    starts = StartCache(folder)
    if starts.names != cache.names[: len(starts)]:
        raise InputError(f"{folder} was made from other samples than those of {cache.folder}")
    return starts
