"""The training loop: exact resume after a kill, gradients shared by processes, errors that name the sample."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from learned.batch import Batch
from learned.training import TrainingConfig, TrainingError, fit, save_atomically

CONFIG = TrainingConfig(steps=12, learning_rate=0.01, warmup=2, checkpoint_every=4, log_every=1, validate_every=4,
                        precision="float32")  # fmt: skip
ROOT = Path(__file__).parents[2]


def make_model() -> torch.nn.Module:
    torch.manual_seed(1)
    # dropout: the random numbers of a step must come back as well
    return torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3, padding=1), torch.nn.Dropout(0.3), torch.nn.Conv2d(4, 1, 1))


def batch_at(index: int) -> Batch:
    generator = torch.Generator().manual_seed(index)
    return Batch(torch.rand(2, 4, 3, 8, 8, generator=generator), names=(f"first-{index}", f"second-{index}"))


def loss(model: torch.nn.Module, batch: Batch) -> tuple[torch.Tensor, dict[str, float]]:
    left1, right1, _, _ = batch.frames
    return (model(left1) - right1.mean(1, keepdim=True)).square().mean(), {"batch": float(len(batch))}


def weights(model: torch.nn.Module) -> torch.Tensor:
    return torch.cat([parameter.detach().flatten() for parameter in model.parameters()])


def train_and_die(folder: str, step: int) -> None:
    """Run in a process of its own: killed while the batch after `step` is made."""

    def deadly(index: int) -> Batch:
        if index == step:
            os.kill(os.getpid(), signal.SIGKILL)
        return batch_at(index)

    fit(make_model(), deadly, loss, CONFIG, folder)


def test_a_killed_run_resumes_exactly(tmp_path: Path):
    whole, resumed = make_model(), make_model()
    fit(whole, batch_at, loss, CONFIG, tmp_path / "whole")
    code = f"from tests.learned.test_training import train_and_die; train_and_die({str(tmp_path / 'killed')!r}, 9)"
    threads = os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())}  # another number rounds otherwise
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=threads, capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    at = torch.load(tmp_path / "killed" / "checkpoint.pt", weights_only=True)["step"]
    assert 0 < at < CONFIG.steps
    fit(resumed, batch_at, loss, CONFIG, tmp_path / "killed")
    assert torch.equal(weights(whole), weights(resumed))
    assert not torch.equal(weights(whole), weights(make_model()))


def test_time_is_up_and_the_run_goes_on(tmp_path: Path):
    whole, pieces = make_model(), make_model()
    fit(whole, batch_at, loss, CONFIG, tmp_path / "whole")
    numbers = fit(pieces, batch_at, loss, CONFIG, tmp_path / "pieces", seconds=0)
    assert numbers["step"] == 1
    fit(pieces, batch_at, loss, CONFIG, tmp_path / "pieces")
    assert torch.equal(weights(whole), weights(pieces))
    lines = [json.loads(line) for line in (tmp_path / "pieces" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == list(range(1, 13))


def test_it_learns(tmp_path: Path):
    model = make_model()
    config = dataclasses.replace(CONFIG, steps=150)
    fit(model, lambda index: batch_at(0), loss, config, tmp_path)
    assert loss(model, batch_at(0))[0] < 0.5 * loss(make_model().eval(), batch_at(0))[0]


def test_the_best_weights_are_kept(tmp_path: Path):
    scores = iter([3.0, 1.0, 2.0])
    seen = []

    def validate(model: torch.nn.Module) -> dict[str, float]:
        assert not model.training
        seen.append(weights(model))
        return {"score": next(scores)}

    fit(make_model(), batch_at, loss, CONFIG, tmp_path, validate)
    best, model = torch.load(tmp_path / "best.pt", weights_only=True), make_model()
    model.load_state_dict(best["model"])
    assert best["step"] == 8
    assert torch.equal(weights(model), seen[1])


def test_frozen_parts_stay(tmp_path: Path):
    model = make_model()
    fit(model, batch_at, loss, dataclasses.replace(CONFIG, frozen=("0.",)), tmp_path)
    assert torch.equal(model[0].weight, make_model()[0].weight)
    assert not torch.equal(model[2].weight, make_model()[2].weight)


def test_frozen_normalisation_keeps_its_statistics(tmp_path: Path):
    layers = torch.nn.Conv2d(3, 4, 1), torch.nn.BatchNorm2d(4), torch.nn.BatchNorm2d(4), torch.nn.Conv2d(4, 1, 1)
    model = torch.nn.Sequential(*layers)
    config = dataclasses.replace(CONFIG, frozen=("0.", "1."))
    fit(model, batch_at, loss, config, tmp_path, lambda model: {"score": 0.0})
    assert torch.equal(model[1].running_var, torch.ones(4))
    assert not torch.equal(model[2].running_var, torch.ones(4))


def test_not_a_number_stops_with_the_samples_name(tmp_path: Path):
    def spoilt(index: int) -> Batch:
        batch = batch_at(index)
        if index == 6:
            batch.images[1, 0, 0, 3, 3] = torch.nan
        return batch

    with pytest.raises(TrainingError, match="step 6, sample second-6"):
        fit(make_model(), spoilt, loss, CONFIG, tmp_path)
    kept = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert all(torch.isfinite(value).all() for value in kept["model"].values())


def test_foreign_and_damaged_checkpoints_are_refused(tmp_path: Path):
    fit(make_model(), batch_at, loss, CONFIG, tmp_path)
    with pytest.raises(TrainingError, match="cannot be continued"):
        fit(torch.nn.Conv2d(3, 1, 1), batch_at, loss, CONFIG, tmp_path)
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(TrainingError, match="cannot be continued"):
        fit(make_model(), batch_at, loss, CONFIG, tmp_path)


def test_a_full_disk_leaves_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "checkpoint.pt"
    save_atomically({"step": 1}, path)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        save_atomically({"step": 2}, path)
    assert torch.load(path, weights_only=True) == {"step": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_the_rate_rises_stays_and_falls():
    config = TrainingConfig(steps=1000, learning_rate=1.0, warmup=9, cooldown=0.5)
    assert config.rate(0) == pytest.approx(0.1)
    assert config.rate(9) == config.rate(500) == 1
    assert config.rate(750) == pytest.approx(0.5)
    assert 0 < config.rate(999) < 1e-4


def train_together(folder: str) -> None:
    """Run by torchrun: every process takes one of a batch's two samples."""
    torch.distributed.init_process_group("gloo")
    model = make_model()
    model[1].p = 0.0
    fit(model, lambda index: batch_at(index // 2)[index % 2], loss, CONFIG, folder)
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_two_processes_do_what_one_does(tmp_path: Path):
    alone = make_model()
    alone[1].p = 0.0
    fit(alone, batch_at, loss, CONFIG, tmp_path / "alone")
    script = tmp_path / "together.py"
    script.write_text(
        f"import sys; sys.path.insert(0, {str(ROOT)!r})\n"
        "from tests.learned.test_training import train_together\n"
        f"train_together({str(tmp_path / 'together')!r})\n"
    )
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300,
                          env=os.environ | {"OMP_NUM_THREADS": "1"})  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    model = make_model()
    model.load_state_dict(torch.load(tmp_path / "together" / "checkpoint.pt", weights_only=True)["model"])
    assert torch.allclose(weights(model), weights(alone), rtol=1e-4, atol=1e-6)
