"""The training loop: ``fit(model, batch_at, loss, config, folder)``. It sees tensors, never a data set.

A step's batch, its augmentation and every random number are functions of the step's number alone, so that a run that
was killed goes on exactly where its last checkpoint stands. Several processes (``torchrun``) average their gradients
(DDP).
"""

from __future__ import annotations

import json
import logging
import math
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from tqdm import tqdm

from learned.batch import Batch

logger = logging.getLogger(__name__)

#: The batch of an index: step number, or step * processes + rank when there are several.
BatchAt = Callable[[int], Batch]
#: The loss of a model on a batch, a scalar; and numbers for the log.
Loss = Callable[[nn.Module, Batch], tuple[Tensor, dict[str, float]]]
#: Scores of a model on held-out samples; "score" decides which checkpoint is the best (smaller is better).
Validate = Callable[[nn.Module], dict[str, float]]
#: Pictures by name, (H, W, 3) uint8 RGB, of what a model makes of held-out samples.
Show = Callable[[nn.Module], dict[str, np.ndarray]]


class TrainingError(RuntimeError):
    """Training cannot go on; the message says at which step and sample, or what to do."""


@dataclass(frozen=True)
class TrainingConfig:
    """How a model is fitted."""

    steps: int = 10_000
    """Length of the run in optimiser steps."""
    learning_rate: float = 1e-4
    """The highest rate; it rises to it linearly and falls at the end."""
    warmup: int = 100
    """Steps of the rise."""
    cooldown: float = 0.3
    """Share of the run at the end in which the rate falls to zero along a half cosine; 0 keeps it constant."""
    optimizer: Literal["adam", "adamw"] = "adamw"
    """adam is the paper's."""
    weight_decay: float = 1e-4
    """Of adamw; adds to the gradient with adam."""
    clip_norm: float = 1.0
    """Largest norm of the gradient; 0 leaves it alone."""
    precision: Literal["float32", "bfloat16"] = "bfloat16"
    """bfloat16: mixed precision, about twice as fast in large convolutions."""
    frozen: tuple[str, ...] = ()
    """Parameters whose names begin with one of these keep their values, and so do the statistics of normalisation in
    modules so named."""
    seed: int = 0
    """Of everything that is drawn."""
    checkpoint_every: int = 200
    """Steps between checkpoints: what a kill can cost."""
    log_every: int = 20
    """Steps between lines of the log."""
    validate_every: int = 500
    """Steps between validations."""
    tensorboard: bool = False
    """Write TensorBoard files too, with pictures at every validation (the package ``tensorboard`` is needed)."""

    def __post_init__(self) -> None:
        if min(self.steps, self.checkpoint_every, self.log_every, self.validate_every) < 1:
            raise ValueError("steps, checkpoint_every, log_every and validate_every must be positive")
        if not (self.learning_rate > 0 and self.warmup >= 0 and 0 <= self.cooldown <= 1):
            raise ValueError("learning_rate must be positive, warmup not negative, cooldown in [0, 1]")

    def rate(self, step: int) -> float:
        """Learning rate of a step, counted from 0."""
        rise = min(1.0, (step + 1) / (self.warmup + 1))
        fall_from = self.steps * (1 - self.cooldown)
        if step <= fall_from:
            return self.learning_rate * rise
        return self.learning_rate * rise * 0.5 * (1 + math.cos(math.pi * (step - fall_from) / (self.steps - fall_from)))


class _Objective(nn.Module):
    """The loss as a module, so that DDP sees one forward pass whatever a loss calls."""

    def __init__(self, model: nn.Module, loss: Loss) -> None:
        super().__init__()
        self.model = model
        self.loss = loss

    def forward(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        return self.loss(self.model, batch)


def fit(
    model: nn.Module,
    batch_at: BatchAt,
    loss: Loss,
    config: TrainingConfig,
    folder: str | Path,
    validate: Validate | None = None,
    seconds: float = math.inf,
    progress: bool = False,
    show: Show | None = None,
) -> dict[str, float]:
    """Train a model in place; a folder with a checkpoint is continued.

    Parameters
    ----------
    model : nn.Module
        On the device to train on.
    batch_at : callable
        A batch for each index; called from one background thread, one step ahead.
    loss : callable
        Scalar loss and numbers for the log.
    config : TrainingConfig
    folder : str or Path
        Gets ``checkpoint.pt`` (everything needed to go on), ``best.pt`` (weights alone, if validated) and
        ``log.jsonl``.
    validate : callable, optional
        Runs on the first process, with the model in evaluation mode and without gradients.
    seconds : float
        Stop (with a checkpoint, to be continued) when this time is over.
    progress : bool
        Show a bar with the time left.
    show : callable, optional
        Pictures for TensorBoard, made at every validation under the same conditions.

    Returns
    -------
    dict
        The last log line's numbers.

    Raises
    ------
    TrainingError
        If the loss or a gradient is not finite (names the sample), or the checkpoint does not fit the model.
    OSError
        If a checkpoint cannot be written (disk full); the previous one is whole.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    device = next(model.parameters()).device
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(not name.startswith(config.frozen))
    run = _Run(model, config, folder)
    step = run.resume(device)
    objective = _Objective(model, loss)
    parallel = dist.is_available() and dist.is_initialized()
    rank, world = (dist.get_rank(), dist.get_world_size()) if parallel else (0, 1)
    # a loss need not reach every parameter, as those of heads that only training alone looks at
    wrapped = DistributedDataParallel(objective, find_unused_parameters=True) if parallel else objective
    trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
    deadline = time.monotonic() + seconds
    numbers: dict[str, float] = {}
    writer = _tensorboard(folder) if config.tensorboard and rank == 0 else None
    bar = tqdm(total=config.steps, initial=step, disable=not progress or rank > 0, dynamic_ncols=True)
    _train_mode(model, config.frozen)
    for batch in _ahead(batch_at, range(step * world + rank, config.steps * world, world)):
        torch.manual_seed(config.seed * 1_000_003 + step)
        for group in run.optimizer.param_groups:
            group["lr"] = config.rate(step)
        run.optimizer.zero_grad(set_to_none=True)
        batch = batch.to(device)
        with _precision(config, device):
            value, numbers = wrapped(batch)
        value.backward()
        norm = nn.utils.clip_grad_norm_(trained, config.clip_norm or math.inf)
        if not (torch.isfinite(value) and torch.isfinite(norm)):
            raise TrainingError(_blame(objective, batch, float(value.detach()), step))
        run.optimizer.step()
        step += 1
        last = step == config.steps or time.monotonic() > deadline
        bar.update()
        if rank == 0:
            numbers = {
                "step": step,
                "loss": float(value.detach()),
                **numbers,
                "rate": config.rate(step - 1),
                "gradient": float(norm),
            }
            if validate and (step % config.validate_every == 0 or step == config.steps):
                numbers |= _validated(model, validate, run, step)
                if show and writer:
                    _write_pictures(writer, model, show, step)
                _train_mode(model, config.frozen)
            if step % config.log_every == 0 or last or "score" in numbers:
                _log(folder / "log.jsonl", numbers, writer)
                bar.set_postfix(loss=f"{numbers['loss']:.3g}")
            if step % config.checkpoint_every == 0 or last:
                run.save(step)
        if last and not parallel:
            break
    bar.close()
    if writer:
        writer.close()
    model.eval()
    return numbers


class _Run:
    """Model, optimiser and their checkpoint."""

    def __init__(self, model: nn.Module, config: TrainingConfig, folder: Path) -> None:
        self.model, self.folder, self.best = model, folder, math.inf
        trained = [parameter for parameter in model.parameters() if parameter.requires_grad]
        kind = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[config.optimizer]
        self.optimizer = kind(trained, config.learning_rate, (0.9, 0.999), weight_decay=config.weight_decay)

    def save(self, step: int) -> None:
        content = {
            "step": step,
            "best": self.best,
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }
        save_atomically(content, self.folder / "checkpoint.pt")

    def resume(self, device: torch.device) -> int:
        """The step to go on with: 0 without a checkpoint."""
        path = self.folder / "checkpoint.pt"
        if not path.exists():
            return 0
        try:
            content = torch.load(path, map_location=device, weights_only=True)
            self.model.load_state_dict(content["model"])
            self.optimizer.load_state_dict(content["optimizer"])
            self.best = content["best"]
            step = int(content["step"])
        except Exception as error:  # whatever a damaged or foreign file makes torch raise
            reason = str(error).splitlines()[0]
            raise TrainingError(f"{path} cannot be continued with this model ({reason}); choose another run folder") from error
        logger.info("continuing %s at step %d", self.folder, step)
        return step


def save_atomically(content: dict[str, Any], path: Path) -> None:
    """``torch.save`` under a temporary name, flushed, then renamed: a kill or a full disk leaves the old file whole."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with temporary.open("wb") as file:
            torch.save(content, file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _ahead(batch_at: BatchAt, indices: range) -> Iterator[Batch]:
    """Batches in order, each made while the one before is used."""
    with ThreadPoolExecutor(1) as pool:
        waiting = None
        for index in indices:
            following = pool.submit(batch_at, index)
            if waiting is not None:
                yield waiting.result()
            waiting = following
        if waiting is not None:
            yield waiting.result()


def _precision(config: TrainingConfig, device: torch.device) -> Any:
    return torch.autocast(device.type, torch.bfloat16) if config.precision == "bfloat16" else nullcontext()


def _blame(objective: nn.Module, batch: Batch, value: float, step: int) -> str:
    """Which sample makes the loss or its gradient infinite or NaN."""
    names = batch.names or tuple(f"number {i}" for i in range(len(batch)))
    for i, name in enumerate(names):
        objective.zero_grad()
        alone, _ = objective(replace(batch[i], names=(name,)))
        alone.backward()
        finite = all(bool(torch.isfinite(p.grad).all()) for p in objective.parameters() if p.grad is not None)
        if not (torch.isfinite(alone) and finite):
            return f"loss or gradient is not finite at step {step}, sample {name} (loss {float(alone.detach())})"
    return f"loss {value} or its gradient is not finite at step {step}; samples {', '.join(names)} are finite one by one"


def _train_mode(model: nn.Module, frozen: tuple[str, ...]) -> None:
    """Training mode for all but frozen modules, whose normalisation would drift otherwise."""
    model.train()
    for name, module in model.named_modules():
        if f"{name}.".startswith(frozen):
            module.eval()


def _validated(model: nn.Module, validate: Validate, run: _Run, step: int) -> dict[str, float]:
    model.eval()
    with torch.no_grad():
        scores = validate(model)
    if scores["score"] < run.best:
        run.best = scores["score"]
        save_atomically({"step": step, "model": model.state_dict()}, run.folder / "best.pt")
    return scores


def _log(path: Path, numbers: dict[str, float], writer: Any) -> None:
    with path.open("a") as file:
        file.write(json.dumps({key: float(f"{value:.6g}") for key, value in numbers.items()}) + "\n")
    if writer:
        for key, value in numbers.items():
            writer.add_scalar(key, value, int(numbers["step"]))


def _write_pictures(writer: Any, model: nn.Module, show: Show, step: int) -> None:
    model.eval()
    with torch.no_grad():
        for name, picture in show(model).items():
            writer.add_image(name, picture, step, dataformats="HWC")


def _tensorboard(folder: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise TrainingError("tensorboard = true needs the package tensorboard: pip install 'cgsf[train]'") from None
    return SummaryWriter(str(folder))
