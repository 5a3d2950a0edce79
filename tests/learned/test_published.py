"""The networks compute what the authors' compute, with their checkpoints.

Outputs of the authors' networks were recorded (data/published_outputs.npz) for weights and inputs made by a rule: the
numbers of a name come from a generator seeded with CRC-32 of ``seed:name``, so that no weights file is needed.
"""

import json
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from learned.checkpoint import CheckpointError, ModelCard, import_published, load, save
from learned.ganet import COMPACT, GANet
from learned.pwcnet import MOTION_UNIT_PX, PWCNet

_DATA = Path(__file__).parent / "data"
_SEED = 7


def _generator(name: str) -> np.random.Generator:
    return np.random.default_rng(zlib.crc32(f"{_SEED}:{name}".encode()))


def _weights(architecture: str) -> dict[str, torch.Tensor]:
    """A state dict with the names and shapes of the authors' checkpoint."""
    shapes = json.loads((_DATA / f"published_{architecture}.json").read_text())
    state = {}
    for name, shape in shapes.items():
        if not shape:
            state[name] = torch.tensor(0)
            continue
        a = _generator(name).standard_normal(shape)
        if len(shape) > 1:
            a *= np.sqrt(2 / np.prod(shape[1:])) * (40 if "conv32x1" in name else 1)
        elif name.endswith(("weight", "running_var")):
            a = 1 + 0.1 * np.abs(a)
        else:
            a *= 0.05
        state[name] = torch.from_numpy(a.astype(np.float32))
    return state


def _image(name: str, shape: tuple[int, ...]) -> torch.Tensor:
    return F.avg_pool2d(torch.from_numpy(_generator(name).random(shape).astype(np.float32)), 5, 1, 2)


def _outputs() -> dict[str, np.ndarray]:
    with np.load(_DATA / "published_outputs.npz") as file:
        return dict(file)


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """Checkpoints as the authors distribute them: one prefixed, the other wrapped as well."""
    folder = tmp_path_factory.mktemp("published")
    torch.save({f"module.{name}": tensor for name, tensor in _weights("pwcnet").items()}, folder / "pwcnet.pth.tar")
    prefixed = {f"module.{name}": tensor for name, tensor in _weights("ganet").items()}
    torch.save({"epoch": 3, "state_dict": prefixed}, folder / "ganet.pth")
    return folder


@torch.no_grad()
def test_pwcnet_reproduces_the_published_network(published):
    net = import_published("pwcnet", published / "pwcnet.pth.tar")
    motions = net.estimate(*(_image(f"pwc.image{i}", (1, 3, 128, 192)) for i in (1, 2)))
    for level, name in ((-1, "pwc_flow2"), (1, "pwc_flow5"), (0, "pwc_flow6")):
        assert np.abs(motions[level][:, :2].numpy() - _outputs()[name]).max() < 1e-4
        assert (motions[level][:, 2] == 0).all(), "the third output is not trained yet"


@torch.no_grad()
def test_ganet_reproduces_the_published_network(published):
    net = import_published("ganet", published / "ganet.pth", max_disparity=48)
    net.config = replace(net.config, normalised_input=False)  # the recorded inputs entered as they are
    disparity = net(*(_image(f"ganet.{side}", (1, 3, 96, 144)) for side in ("left", "right")))
    assert np.abs(disparity.numpy() - _outputs()["ganet_disparity"]).max() < 1e-3


@torch.no_grad()
def test_ganet_in_bfloat16_gives_the_same_disparities(published):
    net = import_published("ganet", published / "ganet.pth", max_disparity=48)
    net.config = replace(net.config, normalised_input=False)
    images = [_image(f"ganet.{side}", (1, 3, 96, 144)) for side in ("left", "right")]
    exact = net(*images)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = net(*images)
    assert 0 < (rounded - exact).abs().mean() < 0.05
    assert exact.max() - exact.min() > 5, "equal disparities would say nothing"


@torch.no_grad()
def test_weights_survive_the_disk(published, tmp_path):
    net = import_published("pwcnet", published / "pwcnet.pth.tar")
    save(net, tmp_path / "flow.safetensors", ModelCard("the authors", "CC BY-NC-SA 4.0"))
    again, card = load(tmp_path / "flow.safetensors")
    first, second = torch.rand((2, 1, 3, 64, 64), generator=torch.Generator().manual_seed(1))
    assert torch.equal(net(first, second), again(first, second))
    assert card == ModelCard("the authors", "CC BY-NC-SA 4.0")
    assert "CC BY-NC-SA 4.0" in (tmp_path / "flow.safetensors.md").read_text()


def test_configurations_survive_the_disk(tmp_path):
    save(GANet(COMPACT), tmp_path / "net.safetensors", ModelCard("nobody"))
    assert load(tmp_path / "net.safetensors")[0].config == COMPACT


def test_a_mismatch_is_refused_by_name(tmp_path):
    state = _weights("pwcnet")
    del state["conv3a.0.bias"]
    state |= {"surprise.weight": torch.zeros(3), "predict_flow4.bias": torch.zeros(7)}
    torch.save(state, tmp_path / "other.pth")
    with pytest.raises(CheckpointError) as refusal:
        import_published("pwcnet", tmp_path / "other.pth")
    for part in ("missing: pyramid.2.0.0.bias", "not wanted: surprise.weight", "decoders.2.predict.bias is (7,)"):
        assert part in str(refusal.value)


def test_weights_of_the_other_network_are_refused(published):
    with pytest.raises(CheckpointError, match=r"missing: pyramid\.0"):
        import_published("pwcnet", published / "ganet.pth")


class _Malicious:
    def __reduce__(self):
        return print, ("code from a checkpoint ran",)


def test_code_in_a_checkpoint_never_runs(tmp_path, capsys):
    torch.save({"state_dict": {"conv1a.0.weight": _Malicious()}}, tmp_path / "evil.pth")
    with pytest.raises(CheckpointError, match="not opened"):
        import_published("pwcnet", tmp_path / "evil.pth")
    assert "ran" not in capsys.readouterr().out


@pytest.mark.parametrize("content", [b"", b"no checkpoint at all"])
def test_rubbish_is_refused(tmp_path, content):
    path = tmp_path / "rubbish.pth"
    path.write_bytes(content)
    with pytest.raises(CheckpointError):
        import_published("pwcnet", path)
    with pytest.raises(CheckpointError):
        load(path)


def test_only_weights_with_a_configuration_load(tmp_path):
    from safetensors.torch import save_file

    save_file({"a": torch.zeros(1)}, tmp_path / "bare.safetensors")
    with pytest.raises(CheckpointError, match="no weights of this program"):
        load(tmp_path / "bare.safetensors")


def test_motion_unit_is_the_published_one():
    assert PWCNet().decoders[0].pixels == MOTION_UNIT_PX / 64 == 0.3125
